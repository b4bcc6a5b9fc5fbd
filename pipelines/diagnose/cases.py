"""Print the guide's table: what `sweep diagnose` says of public questions (cases.toml)."""

import tomllib
from pathlib import Path

import sweep

HERE = Path(__file__).parent


def cases():
    """Return each case with the findings of its rows."""
    for case in tomllib.loads((HERE / "cases.toml").read_text())["case"]:
        yield case, sweep.diagnose(case["rows"], **case.get("settings", {}))


def row(case, found):
    """Return a row of the guide's table."""
    causes = "; ".join(
        f"{' + '.join(each['causes'])} {each['probability']:.2f}"
        for each in found.numbers["causes"][:2])
    where = case["source"].split(" ")[0]
    name = "/".join(where.removesuffix("/").split("/")[2:])
    name = name if len(name) < 50 else f"{name[:47]}..."
    told = "told" if found.numbers["decided"] else "open"
    return (f"| [{name}]({where}) | {case['said']} | {causes} ({told}) | "
            f"{case['found'] or '-'} |")


if __name__ == "__main__":
    print("| source | numbers | causes first and second | thread found |")
    print("| --- | --- | --- | --- |")
    for each, answer in cases():
        print(row(each, answer))
