"""What is written for a user: whole, under its name at once, and through no link."""

import stat
import uuid

import pytest

from sweep.store.files import whole_file, write_whole


def test_a_file_is_replaced_whole_or_not_at_all_and_keeps_its_permissions(tmp_path):
    path = tmp_path / "result"
    write_whole(path, b"first")
    path.chmod(0o640)
    with pytest.raises(TypeError), whole_file(path) as file:
        file.writelines([b"half", None])
    assert path.read_bytes() == b"first"
    write_whole(path, b"second")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"second", 0o640)
    assert [each.name for each in tmp_path.iterdir()] == ["result"]


def test_nothing_is_written_through_links_that_wait(tmp_path, monkeypatch):
    outside = tmp_path / "mine.txt"
    outside.write_text("mine")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "result").symlink_to(outside)
    write_whole(folder / "result", b"ours")
    assert outside.read_text() == "mine"
    # Even under the name that cannot be foreseen.
    monkeypatch.setattr(uuid, "uuid4", lambda: uuid.UUID(int=5))
    (folder / f".sweep-{uuid.UUID(int=5).hex}").symlink_to(outside)
    with pytest.raises(FileExistsError):
        write_whole(folder / "other", b"ours")
    assert outside.read_text() == "mine"
