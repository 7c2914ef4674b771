"""README.md of an exported file: its inputs and outputs, and how to call it. The texts are in the folder texts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

TEXTS = Path(__file__).with_name("texts")


def port_table(ports: Sequence[Mapping[str, Any]]) -> str:
    rows = (f"| `{p['name']}` | {p['dtype']} | {' × '.join(map(str, p['shape']))} | {p['meaning']} |" for p in ports)
    return "\n".join(["| name | type | shape | meaning |", "| --- | --- | --- | --- |", *rows])


def instructions(manifest: Mapping[str, Any]) -> str:
    """The text, in Markdown."""
    texts = {path.stem: path.read_text() for path in TEXTS.iterdir()}
    cpp = f"```cpp\n{texts['cpp'].replace('FILE', manifest['file'])}```"
    return texts["README"].format(
        denoiser=manifest["denoiser"],
        file=manifest["file"],
        inputs=port_table(manifest["inputs"]),
        outputs=port_table(manifest["outputs"]),
        state="\n".join(f"- `{each['input']}`: `{each['from']}` of the previous frame" for each in manifest["state"]),
        history=texts[manifest["warp"]].strip(),
        python=texts[manifest["format"]],
        cpp=cpp if manifest["format"] == "onnx" else "Export to ONNX: `onespp export … --to onnx`.",
    )
