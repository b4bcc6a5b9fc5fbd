"""Calls in this process that are made in a child process: quicker, where nothing is to crash."""

import contextlib
from unittest import mock

from sweep.isolation.child_process import Child


class Here:
    """In the place of `sweep.isolation.child_process.Child`."""

    def __init__(self, *_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def call(self, function, *arguments, limit_s):
        assert limit_s > 0
        return function(*arguments)

    def close(self):
        pass


@contextlib.contextmanager
def calls_here():
    """No child process is started while this is entered: unit tests run so.

    A busy machine does not make a small run a large one, which would start others.
    """
    own = {name: getattr(Here, name) for name in ("__init__", "call", "close")}
    with (
        mock.patch.multiple(Child, **own),
        mock.patch("sweep.execution.forecast.SMALL_RUN_S", 300.0),
    ):
        yield
