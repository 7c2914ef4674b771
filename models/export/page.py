"""The page that goes with an exported file: what goes in and out, and how it is called."""

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


def step(frame, state):  # dictionaries of arrays: inputs that each frame brings, and those that are state
    inputs = {**frame, **state}
    outputs = dict(zip(names, session.run(names, inputs)))
    known = {**inputs, **outputs}
    return outputs["radiance"], {name: known[source] for name, source in carried.items()}
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
def step(frame, state):  # dictionaries of tensors: inputs that each frame brings, and those that are state
    inputs = {**frame, **state}
    outputs = program({name: inputs[name] for name in names})
    known = {**inputs, **outputs}
    return outputs["radiance"], {name: known[source] for name, source in carried.items()}
""",
}

CPP = """Ort::Env env;
Ort::Session session(env, "FILE", Ort::SessionOptions{});
Ort::IoBinding step(session);
step.BindInput("noisy", noisy);  // and so on: an Ort::Value for every input, made once over the renderer's buffers
step.BindOutput("radiance", radiance);
for (;;) {
  for (size_t i = 0; i < state.size(); ++i) {  // history and scale, two buffers each: the last frame's, the next one's
    step.BindInput(state_inputs[i], state[i]);
    step.BindOutput(state_outputs[i], next_state[i]);
  }
  session.Run(Ort::RunOptions{}, step);
  std::swap(state, next_state);  // and the buffers of depth, normal and so on with those of previous_depth, ...
}
"""

INSIDE = """What is named `previous_…` is the input of the frame before: keep two buffers of each, and copy nothing. The
transforms of `to_previous_camera` are products of matrices of large numbers: multiply in float64, then round."""

OUTSIDE = """Before each frame but the first, move `history` along with the surfaces: at each pixel, what `new_history`
held where its surface was in the frame before, and 0 in all channels where that surface was not seen: one of them is a
length, and where it is 0 the denoiser starts anew."""


def table(ports: Sequence[Mapping[str, Any]]) -> str:
    rows = (f"| `{p['name']}` | {p['dtype']} | {' × '.join(map(str, p['shape']))} | {p['meaning']} |" for p in ports)
    return "\n".join(["| name | type | shape | meaning |", "| --- | --- | --- | --- |", *rows])


def page(manifest: Mapping[str, Any]) -> str:
    """The page, in Markdown."""
    kind = manifest["format"]
    cpp = f"```cpp\n{CPP.replace('FILE', manifest['file'])}```"
    if kind != "onnx":
        cpp = "Take the ONNX file: `onespp export … --to onnx`."
    state = "\n".join(f"- `{each['input']}` is `{each['from']}` of the frame before" for each in manifest["state"])
    return f"""# {manifest["denoiser"]} as {manifest["file"]}

One frame in, one frame out, at any size from 2 × 2 pixels on. Images are (1, channels, height, width), their rows from
the top.
`manifest.json` says the same to programs, with the SHA-256 of every file; `golden/` holds a sequence of frames as
`input.NAME` and `output.NAME`, to test an integration with.

## In

{table(manifest["inputs"])}

## Out

{table(manifest["outputs"])}

## From frame to frame

{state}

All state is 0 before the first frame and after a cut. {INSIDE if manifest["warp"] == "inside" else OUTSIDE}
`noisy` is mended where it is not finite; all other inputs must be finite.

## Calls

```python
{PYTHON[kind]}```

In terms of C++:

{cpp}
"""
