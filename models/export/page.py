"""README.md of an exported file: its inputs and outputs, and how to call it."""

from collections.abc import Mapping, Sequence
from typing import Any

PYTHON = {
    "onnx": """import json

import numpy as np
import onnxruntime

manifest = json.load(open("manifest.json"))
session = onnxruntime.InferenceSession(manifest["file"], providers=["CPUExecutionProvider"])
names = [port["name"] for port in manifest["outputs"]]
carried = {each["input"]: each["from"] for each in manifest["state"]}


def first_state(height, width):
    sizes = {"height": height, "width": width}
    ports = [port for port in manifest["inputs"] if port["name"] in carried]
    return {port["name"]: np.zeros([sizes.get(n, n) for n in port["shape"]], port["dtype"]) for port in ports}


def step(frame, state):  # dictionaries of arrays: the frame's inputs, and the state
    inputs = {**frame, **state}
    outputs = dict(zip(names, session.run(names, inputs)))
    tensors = {**inputs, **outputs}
    return outputs["radiance"], {name: tensors[source] for name, source in carried.items()}
""",
    "pt2": """import json

import torch

manifest = json.load(open("manifest.json"))
program = torch.export.load(manifest["file"]).module()
names = [port["name"] for port in manifest["inputs"]]
carried = {each["input"]: each["from"] for each in manifest["state"]}


def first_state(height, width):
    sizes = {"height": height, "width": width}
    ports = [port for port in manifest["inputs"] if port["name"] in carried]
    shapes = {port["name"]: ([sizes.get(n, n) for n in port["shape"]], getattr(torch, port["dtype"])) for port in ports}
    return {name: torch.zeros(shape, dtype=dtype) for name, (shape, dtype) in shapes.items()}


@torch.no_grad()
def step(frame, state):  # dictionaries of tensors: the frame's inputs, and the state
    inputs = {**frame, **state}
    outputs = program({name: inputs[name] for name in names})
    tensors = {**inputs, **outputs}
    return outputs["radiance"], {name: tensors[source] for name, source in carried.items()}
""",
}

CPP = """Ort::Env env;
Ort::Session session(env, "FILE", Ort::SessionOptions{});
Ort::IoBinding step(session);
step.BindInput("noisy", noisy);  // and so on: an Ort::Value for every input, over the renderer's buffers
step.BindOutput("radiance", radiance);
for (;;) {
  for (size_t i = 0; i < state.size(); ++i) {  // history and scale: double-buffered
    step.BindInput(state_inputs[i], state[i]);
    step.BindOutput(state_outputs[i], next_state[i]);
  }
  session.Run(Ort::RunOptions{}, step);
  std::swap(state, next_state);  // and the buffers of depth, normal and so on with those of previous_depth, ...
}
"""

WARP_INSIDE = """\
Inputs named `previous_…` are those of the previous frame: double-buffer them, without copying. Multiply the
matrices of `to_previous_camera` in float64 and round the product to float32, since translations can be large."""

WARP_OUTSIDE = """\
Before each frame but the first, reproject `history`: each pixel gets the `new_history` of the pixel that
showed its surface in the previous frame, and 0 in all channels where the surface was not visible there. One of the
channels is a length: where it is 0, the denoiser starts anew."""


def port_table(ports: Sequence[Mapping[str, Any]]) -> str:
    rows = (f"| `{p['name']}` | {p['dtype']} | {' × '.join(map(str, p['shape']))} | {p['meaning']} |" for p in ports)
    return "\n".join(["| name | type | shape | meaning |", "| --- | --- | --- | --- |", *rows])


def instructions(manifest: Mapping[str, Any]) -> str:
    """The text, in Markdown."""
    kind = manifest["format"]
    cpp = f"```cpp\n{CPP.replace('FILE', manifest['file'])}```"
    if kind != "onnx":
        cpp = "Export to ONNX: `onespp export … --to onnx`."
    state = "\n".join(f"- `{each['input']}`: `{each['from']}` of the previous frame" for each in manifest["state"])
    return f"""# {manifest["denoiser"]} as {manifest["file"]}

Each call denoises one frame, of any size from 2 × 2 pixels. Images have the shape (1, channels, height, width), top row
first; radiance is linear RGB. `manifest.json` contains the same description for programs, and the SHA-256 of every
file. Test an integration with the sequence in `golden/`, whose arrays are named `input.NAME` and `output.NAME`.

## Inputs

{port_table(manifest["inputs"])}

## Outputs

{port_table(manifest["outputs"])}

## State

{state}

All state is 0 before the first frame and after a cut. {WARP_INSIDE if manifest["warp"] == "inside" else WARP_OUTSIDE}
Non-finite values in `noisy` count as 0; all other inputs must be finite.

## Calls

```python
{PYTHON[kind]}```

In C++:

{cpp}
"""
