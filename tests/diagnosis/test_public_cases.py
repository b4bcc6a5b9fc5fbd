"""Public questions: the cause that a thread found out is ranked first, or second."""

import runpy
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "pipelines" / "diagnose"
CASES = runpy.run_path(str(FOLDER / "cases.py"))


def test_public_cases_are_ranked_as_their_threads_found_out():
    answers = list(CASES["cases"]())
    known = [(case["found"], [each["causes"] for each in found.numbers["causes"]])
             for case, found in answers if case["found"]]
    assert len(answers) >= 12
    assert sum([found] == causes[0] for found, causes in known) >= 0.7 * len(known)
    assert sum([found] in causes[:2] for found, causes in known) >= 0.9 * len(known)


def test_the_guide_has_the_rows_whose_threads_found_the_cause():
    guide = (FOLDER / "README.md").read_text()
    for case, found in CASES["cases"]():
        assert (CASES["row"](case, found) in guide) == bool(case["found"])
