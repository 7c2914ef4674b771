"""The map of docs/architecture.md, made of the files' own first sentences.

`python -m tests.helpers.architecture` writes it anew.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

from provenance import BESIDE_THEM, FOLDERS, ROOT

PAGE = ROOT / "docs" / "architecture.md"
HEADING = "## The map\n"
SHARED = sorted(f"{name}.py" for name in ("onespp", "command_line", *BESIDE_THEM))


def modules() -> list[Path]:
    """All source files, folder by folder, tests left out; relative to the root."""
    files = [file.relative_to(ROOT) for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")]
    places = {folder: place for place, folder in enumerate(FOLDERS)}
    return sorted(files, key=lambda file: (places[file.parts[0]], file.parent, file.name))


def first_sentences(file: Path) -> str:
    """The first paragraph of a module's docstring, on one line."""
    text = ast.get_docstring(ast.parse((ROOT / file).read_text())) or ""
    return " ".join(text.partition("\n\n")[0].split())


def table(files: list[Path]) -> Iterator[str]:
    yield "| file | holds |"
    yield "| --- | --- |"
    for file in files:
        if file.name != "__init__.py":
            yield f"| `{file}` | {first_sentences(file).rstrip('.')} |"
    yield ""


def drawn_map() -> str:
    lines = ["### Beside the folders", "", *table([Path(name) for name in SHARED])]
    files = modules()
    for folder in dict.fromkeys(file.parent for file in files):
        lines += [f"### `{folder}/`", "", first_sentences(folder / "__init__.py"), ""]
        lines += table([file for file in files if file.parent == folder])
    return "\n".join(lines)


if __name__ == "__main__":
    text = PAGE.read_text()
    PAGE.write_text(text[: text.index(HEADING)] + HEADING + "\n" + drawn_map())
