"""The table of claims has the worst of all cases, and says which shards are missing."""

import json

from tests import evidence

PART = {
    "version": "1.0", "commit": "abc", "shards": 2, "date": "2026-01-01", "processor": "p",
    "python": "3.11", "libraries": dict.fromkeys(evidence.LIBRARIES, "5"),
}


def test_shards_are_joined_and_faults_named(tmp_path, capsys):
    page = tmp_path / "README.md"
    page.write_text(f"before\n{evidence.BEGIN}\nold\n{evidence.END}\nafter\n")
    files = []
    for shard, worst in ((1, 2e-13), (2, 3e-12)):
        files.append(str(tmp_path / f"{shard}.json"))
        (tmp_path / f"{shard}.json").write_text(json.dumps({
            **PART, "shard": shard, "status": 0, "seconds": {"t": 1800},
            "claims": [{"what": "pixels", "against": "clipping", "unit": "px", "worst": worst}],
            "outcomes": {"t": {"passed": 3}, "u": {"failed": shard - 1}}}))
    assert evidence.table(*files, page=page) == 1
    assert "failed: u" in capsys.readouterr().out
    text = page.read_text()
    assert "| pixels | clipping | 3e-12 px |" in text
    assert "6 passed, 1.0 hours." in text.replace("1 failed, ", "")
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert evidence.table(files[0], page=page) == 1
    assert "missing, or not ended: shards 2 of 2" in capsys.readouterr().out
    stopped = tmp_path / "stopped.json"
    stopped.write_text(json.dumps(json.loads((tmp_path / "1.json").read_text()) | {"status": None}))
    assert evidence.table(str(stopped), files[1], page=page) == 1
    assert "missing, or not ended: shards 1 of 2" in capsys.readouterr().out
