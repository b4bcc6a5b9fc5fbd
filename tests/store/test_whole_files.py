"""What is written for a user: whole, under its name at once, and through no link."""

import stat
import uuid

import pytest

from sweep.cli import main
from sweep.store.files import whole_file, write_whole

PIPELINE = "[pose]\ndistance_m = 0.3\njitter_px = 0.5\n[axes]\ntrial = 2\n"


@pytest.fixture
def outside(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text("mine")
    return path


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


def test_nothing_is_written_through_links_that_wait(tmp_path, outside, monkeypatch):
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


def test_an_export_writes_through_no_link(tmp_path, outside, capsys):
    file, folder = tmp_path / "few.toml", tmp_path / "exported"
    file.write_text(PIPELINE)
    assert main(["export", str(file), str(folder)]) == 0
    names = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert len(names) > 6
    for name in names:
        for waiting in (f"{name}.part", f"{name}.tmp"):
            (folder / waiting).symlink_to(outside)
        if name.suffix not in (".json", ".png"):  # what says that the export was begun, and images
            (folder / name).unlink()
            (folder / name).symlink_to(outside)
        elif name.suffix == ".png":
            (folder / name).unlink()
    capsys.readouterr()
    assert main(["export", str(file), str(folder)]) == 0, capsys.readouterr().err
    assert outside.read_text() == "mine"
