"""Pages in one file that needs nothing else: templates, and data that their scripts unpack."""

import base64
import json
import zlib
from importlib import resources
from typing import Any

import numpy as np


def deflated(content: bytes) -> str:
    """In base64."""
    return base64.b64encode(zlib.compress(content, 9)).decode()


def packed(words: bytes) -> str:
    """32-bit words as their differences, the lowest bytes of all first: so images deflate to a tenth and less."""
    differences = np.diff(np.frombuffer(words, "<u4"), prepend=np.uint32(0))
    return deflated(differences.view(np.uint8).reshape(-1, 4).T.tobytes())


def filled(template: str, data: Any) -> str:
    """A template with JSON in place of `/* DATA */ null`, our style, and the functions that unpack what is packed."""
    files = resources.files("web_page")
    page = template.replace("/* STYLE */", files.joinpath("style.css").read_text())
    page = page.replace("/* UNPACK */", files.joinpath("unpack.js").read_text())
    return page.replace("/* DATA */ null", json.dumps(data).replace("</", "<\\/"))
