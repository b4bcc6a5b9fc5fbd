"""Files that commands write: whole, through links, and never in place of a device."""

import stat

import pytest

from sweep.errors import StoreError
from sweep.report.output_file import check_output_file, write_output_file


def told(path):
    """Return the one line that a path is refused with, before and while it is written."""
    lines = set()
    for refused in (check_output_file, lambda path: write_output_file(path, b"new")):
        with pytest.raises(StoreError) as error:
            refused(path)
        lines.add(str(error.value))
    assert len(lines) == 1
    return lines.pop()


def test_an_existing_file_is_replaced_at_once_and_keeps_its_mode(tmp_path):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    path.chmod(0o640)
    with path.open("rb") as held:
        check_output_file(path)
        write_output_file(path, b"new")
        assert held.read() == b"old"
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_and_its_file_is_written(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    link = tmp_path / "link.html"
    link.symlink_to(folder / "real.html")
    for content in (b"first", b"second"):
        check_output_file(link)
        write_output_file(link, content)
        assert link.is_symlink()
        assert (folder / "real.html").read_bytes() == content
    assert len(list(folder.iterdir())) == 1


def test_what_cannot_be_written_is_told_in_a_line(tmp_path):
    file, loop = tmp_path / "file", tmp_path / "loop"
    file.write_text("mine")
    loop.symlink_to(loop)
    for path, line in {
        tmp_path: "it is a folder; choose a file in it",
        tmp_path / "none" / "file": f"folder {tmp_path / 'none'} not found",
        file / "x": f"folder {file} not found",
        loop: "Too many levels of symbolic links",
        tmp_path / ("x" * 300): "File name too long",
        tmp_path / "a\0b": "embedded null byte",
    }.items():
        assert told(path).endswith(f": cannot be written: {line}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop"]
