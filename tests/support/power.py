"""A disk whose power fails: what was flushed survives, of the rest any part.

The changes below a folder are recorded while work is done there. At any instant, a state of the
disk is made: of names (files that were renamed, folders that were made, files that were deleted)
those whose folder was flushed afterwards survive, of files the contents that were flushed; of
everything else a part that is drawn at random: contents whole, cut or empty.
"""

import contextlib
import os
from pathlib import Path


class Recorded:
    """What was done to a disk, in order: tuples of a kind and its paths below the folder."""

    def __init__(self, folder):
        self.folder = Path(os.path.realpath(folder))
        self.events = []

    def _below(self, path):
        path = Path(os.fspath(path))
        with contextlib.suppress(ValueError):
            real = Path(os.path.realpath(path.parent), path.name)
            return real.relative_to(self.folder).as_posix()
        return None

    @contextlib.contextmanager
    def recording(self, patch):
        """Record what is done in the body; ``patch`` is pytest's monkeypatch."""
        real = {name: getattr(os, name) for name in
                ("replace", "rename", "link", "unlink", "mkdir", "fsync")}

        def moved(name):
            def move(source, target, **options):
                old, new = self._below(source), self._below(target)
                content = None if Path(source).is_dir() else Path(source).read_bytes()
                real[name](source, target, **options)
                if new is not None:
                    self.events.append(("move", old, new, content))

            return move

        def unlink(path, *, dir_fd=None):
            if dir_fd is None and (below := self._below(path)) is not None and Path(path).exists():
                self.events.append(("delete", below))
            return real["unlink"](path, dir_fd=dir_fd)

        def mkdir(path, *arguments, **options):
            real["mkdir"](path, *arguments, **options)
            if (below := self._below(path)) is not None:
                self.events.append(("folder", below))

        def fsync(descriptor):
            number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
            path = Path(f"/proc/self/fd/{number}").readlink()
            real["fsync"](number)
            if path == self.folder or self.folder in path.parents:
                self.events.append(("flush", path.relative_to(self.folder).as_posix()))

        with patch.context() as then:
            for name in ("replace", "rename", "link"):
                then.setattr(os, name, moved(name))
            then.setattr(os, "unlink", unlink)
            then.setattr(os, "mkdir", mkdir)
            then.setattr(os, "fsync", fsync)
            yield

    def make_state(self, instant, to, draw):
        """Make in a folder what may be on the disk after a power failure at an instant."""
        events = self.events[:instant]
        flushes = {}  # path -> when it was flushed
        for k, event in enumerate(events):
            if event[0] == "flush":
                flushes.setdefault(event[1], []).append(k)
        renamed = [(k, event[1], event[2]) for k, event in enumerate(events)
                   if event[0] == "move" and event[3] is None]
        chance = draw.choice((0.0, 0.1, 0.5, 0.9))
        to.mkdir()
        for k, (kind, *paths) in enumerate(events):
            if kind == "flush":
                continue
            target = paths[-1] if kind in ("folder", "delete") else paths[1]
            # Its folder may have had another name when it was flushed; that counts, too.
            folders = self._names_of(_parent(target), renamed, k)
            if not any(flushes.get(name, [-1])[-1] > k for name in folders) and (
                draw.random() >= chance
            ):
                continue
            with contextlib.suppress(FileNotFoundError, NotADirectoryError, FileExistsError):
                if kind == "folder":
                    (to / target).mkdir()
                elif kind == "delete":
                    (to / target).unlink()
                elif paths[2] is None:
                    (to / paths[0]).rename(to / target)
                else:
                    flushed = any(j < k for j in flushes.get(paths[0], ())) or any(
                        j > k for name in self._names_of(target, renamed, k)
                        for j in flushes.get(name, ())
                    )
                    content = paths[2]
                    if not flushed and draw.random() >= chance:
                        content = content[: draw.choice((0, len(content) // 2))]
                    (to / target).write_bytes(content)

    @staticmethod
    def _names_of(path, renamed, since):
        """Return the names that a path has after an instant: folders above it may be renamed."""
        names = [path]
        for k, old, new in renamed:
            if k > since and f"{names[-1]}/".startswith(f"{old}/"):
                names.append(new + names[-1][len(old):])
        return names


def _parent(path):
    return Path(path).parent.as_posix()
