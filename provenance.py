"""Provenance of results: the packages, the device and the code that made them."""

import ast
import hashlib
import platform
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypedDict

ROOT = Path(__file__).parent
FOLDERS = ("scenes", "render", "datasets", "models", "train", "eval", "denoise")
BESIDE_THEM = ("errors", "files", "plotting", "process", "provenance", "timing")

# Packages that determine the bytes of a dataset, results of denoising, and trained weights.
RENDERING = ("onespp", "mitsuba", "drjit", "numpy")
DENOISING = ("onespp", "torch", "numpy", "numba", "flip-evaluator", "pyoidn")
TRAINING = ("torch", "numpy", "numba", "lightning-fabric")


def versions(packages: Sequence[str]) -> dict[str, str]:
    """The versions of those packages that are installed."""
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def device_in_words(kind: str = "cpu", threads: int | None = None) -> str:
    """The name of the GPU, or of the processor with its number of threads, by default as many as PyTorch uses."""
    import torch  # takes a second, which rendering does not wait for

    if kind == "cuda":
        return f"cuda, {torch.cuda.get_device_name()}"
    return f"cpu, {processor_name()}, {threads or torch.get_num_threads()} threads"


def processor_name() -> str:
    """The model of the processor, or else its architecture."""
    try:
        model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    except OSError:
        model = None
    return model[1] if model else platform.machine()


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


@cache
def code_digest(*modules: str) -> str:
    """SHA-256 of the sources of onespp's `modules` and of all modules that they import, directly or not."""
    contents = (path.read_bytes() for _, path in sorted(sources(*modules).items()))
    return hashlib.sha256(b"\0".join(contents)).hexdigest()


def sources(*modules: str) -> dict[str, Path]:
    """The files of onespp's `modules` and of all modules that they import, directly or not, by module name."""
    found: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        path = source_of(module)
        if path is not None and module not in found:
            found[module] = path
            waiting += imported_by(path)
            waiting.append(module.rpartition(".")[0])  # importing a module runs its package first
    return found


def source_of(module: str) -> Path | None:
    """The file of one of onespp's modules; None for other names."""
    path = ROOT.joinpath(*module.split("."))
    is_ours = module.split(".")[0] in FOLDERS + BESIDE_THEM
    files = (path / "__init__.py", path.with_suffix(".py"))
    return next((file for file in files if is_ours and file.is_file()), None)


def imported_by(path: Path) -> Iterator[str]:
    """Names that a source file imports: modules, and members that may be modules themselves; not those for types."""
    nodes: list[ast.AST] = [ast.parse(path.read_bytes())]
    while nodes:
        node = nodes.pop()
        if not (isinstance(node, ast.If) and getattr(node.test, "id", None) == "TYPE_CHECKING"):
            nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


class MadeBy(TypedDict):
    """What a training ran with: weights and checkpoints name it."""

    versions: dict[str, str]  # by package
    code: str  # its digest


def made_by_here(*modules: str) -> MadeBy:
    """The packages installed here, and the code of `modules`."""
    return {"versions": versions(TRAINING), "code": code_digest(*modules)}


def differences(recorded: Sequence[MadeBy], here: MadeBy) -> str:
    """How what a training ran with differs from here, "other code, torch 2.12.0 (now 2.13.0)"; empty if it does not."""
    changes: dict[str, None] = {}  # an ordered set
    for made_by in recorded:
        if made_by["code"] != here["code"]:
            changes["other code"] = None
        for package in TRAINING:
            then, now = (each["versions"].get(package, "none") for each in (made_by, here))
            if then != now:
                changes[f"{package} {then} (now {now})"] = None
    return ", ".join(changes)
