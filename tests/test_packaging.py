"""What strangers meet before the first run: workflow, package page, citation, issue forms."""

import re
import runpy
import tomllib
from pathlib import Path

import yaml

import sweep

TOP = Path(__file__).parent.parent
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]
WORKFLOW = (TOP / ".github" / "workflows" / "ci.yml").read_text()
JOBS = yaml.safe_load(WORKFLOW)["jobs"]
README = (TOP / "README.md").read_text()
LINK = re.compile(r"\]\(([^)\s]*)\)|src=\"([^\"]*)\"")

description = runpy.run_path(str(TOP / "setup.py"))["description"]


def test_every_shard_of_the_long_tests_is_in_the_workflow():
    runs = [step.get("run", "") for step in JOBS["evidence"]["steps"]]
    run, = (each for each in runs if "--shard" in each)
    shards = JOBS["evidence"]["strategy"]["matrix"]["shard"]
    assert shards == list(range(1, len(shards) + 1))
    assert run.endswith(f"/{len(shards)}")


def test_workflow_names_files_and_extras_that_exist():
    runs = [step["run"] for job in JOBS.values() for step in job["steps"] if "run" in step]
    named = {path for run in runs for path in re.findall(r"(?<!\S)(?:\.ci|pipelines)/\S+", run)}
    assert {".ci/run", ".ci/versions", ".ci/wheel"} <= named
    for path in named:
        assert (TOP / path).is_file(), path
    extras = {extra for run in runs for extra in re.findall(r"'\.\[(\w+)\]'", run)}
    assert extras <= set(PROJECT["optional-dependencies"])


def test_scripts_name_tests_that_exist():
    for script in (path for path in (TOP / ".ci").iterdir() if path.is_file()):
        for path in re.findall(r"(?<![\w/])tests/[\w/]+(?:\.py)?", script.read_text()):
            assert (TOP / path).exists(), f"{script.name}: {path}"


def test_pythons_that_are_promised_are_tried():
    tried = JOBS["pythons"]["strategy"]["matrix"]["python"]
    promised = [found[1] for each in PROJECT["classifiers"]
                if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", each))]
    assert PROJECT["requires-python"] == f">={promised[0]}"
    assert set(promised) <= set(tried)
    assert (f"Python {tried[-1]}" in WORKFLOW) == (tried[-1] not in promised)


def links(page):
    return ["".join(found) for found in LINK.findall(page)]


def test_package_page_has_no_link_that_leads_nowhere():
    page = description(README, PROJECT.get("urls", {}).get("Source", ""), sweep.__version__)
    assert [link for link in links(page) if not link.startswith(("https://", "#"))] == []
    assert len(links(page)) < len(links(README)) or "urls" in PROJECT


def test_links_of_a_hosted_tree_are_absolute_and_lead_to_files_of_the_tree():
    page = description(README, "https://host.example/owner/tree/", "1.2.3")
    tree = "https://host.example/owner/tree"
    made = [link for link in links(page) if link.startswith(tree)]
    assert len(made) == len([link for link in links(README) if not link.startswith("https:")])
    for link in made:
        kind, version, path = link.removeprefix(f"{tree}/").split("/", 2)
        assert (kind, version) in {("blob", "v1.2.3"), ("raw", "v1.2.3")}
        assert (TOP / path.partition("#")[0]).exists(), link
