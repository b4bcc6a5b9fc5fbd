"""Tables as the guides have them: Markdown, a row as soon as it is measured."""


def row(*cells):
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def header(*names):
    row(*names)
    row(*["---"] * len(names))
