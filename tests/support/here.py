"""Calls in this process that are made in a child process: quicker, where nothing is to crash."""

import contextlib
from unittest import mock


class Here:
    """In the place of `sweep.isolation.child_process.Child`."""

    def __init__(self, *_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def call(self, function, *arguments, limit_s, grace_s=1.0):
        assert limit_s > 0 < grace_s
        return function(*arguments)

    def close(self):
        pass

    def restart(self):
        pass


@contextlib.contextmanager
def calls_here():
    """Small runs and measurements of what they take start no process while this is entered.

    A busy machine does not make a small run a large one, which would start others.
    """
    with (
        mock.patch("sweep.isolation.child_process.Child", Here),
        mock.patch("sweep.execution.runner.Child", Here),
        mock.patch("sweep.execution.runner.SMALL_RUN_S", 300.0),
        mock.patch("sweep.execution.forecast.SMALL_RUN_S", 300.0),
        mock.patch("sweep.execution.executors.SMALL_RUN_LIMIT_S", 300.0),
    ):
        yield
