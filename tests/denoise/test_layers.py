"""Layers are recognised by common names after any prefix, and by names that the user gives."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from denoise.layers import QUANTITIES, candidates, list_layers, named_layer, parse_layers
from errors import BadInput


def channels(*layers: str) -> list[str]:
    """Names of channels from layers with their components: "Albedo.RGB"."""
    names = []
    for text in layers:
        layer, dot, letters = text.rpartition(".")
        names += [f"{layer}{dot}{letter}" for letter in letters]
    return names


EVERYDAY = {
    "colour": ["RGB", "Combined.RGBA", "Noisy Image.RGB", "Beauty.RGB", "Composite.Combined.RGB", "rgba.RGBA"],
    "albedo": ["albedo.RGB", "Denoising Albedo.RGB", "DiffCol.RGB", "VisibleDiffuse.RGB", "Albedo.RGB"],
    "normal": ["N.XYZ", "Normals.XYZ", "Denoising Normal.XYZ", "VisibleNormals.RGB", "OptixNormals.RGB", "Ns.XYZ"],
    "position": ["P.XYZ", "Position.XYZ"],
    "depth": ["Z", "Depth.Z", "depth.V", "Denoising Depth.Z"],
    "motion": ["Vector.XYZW", "motion.XY", "MotionVector.RG", "velocity.XYZ"],
    "emission": ["Emit.RGB", "emission.RGB"],
}
PREFIXES = ["", "ViewLayer.", "Scene.View Layer.001."]
CASES = [
    (quantity, layer, prefix)
    for quantity, layers in EVERYDAY.items()
    for layer in layers
    for prefix in PREFIXES
    if "." in layer or not prefix  # plain channels have nothing before them
]


@pytest.mark.parametrize(("quantity", "layer", "prefix"), CASES)
def test_common_names_are_recognised(quantity, layer, prefix):
    layers = candidates(quantity, channels("Mist.Z", "Crypto00.RGBA", "uv.UV", prefix + layer))
    assert len(layers) == 1 and set(layers[0].channels) <= set(channels(prefix + layer))
    others = set(QUANTITIES) - {quantity}
    assert not any(candidates(other, channels(prefix + layer)) for other in others)


def test_the_best_name_comes_first():
    names = channels("Composite.Combined.RGBA", "ViewLayer.Combined.RGBA", "ViewLayer.Noisy Image.RGBA")
    best_first = ["ViewLayer.Noisy Image", "ViewLayer.Combined", "Composite.Combined"]
    assert [layer.name for layer in candidates("colour", names)] == best_first
    assert candidates("motion", channels("Vector.XYZW"))[0].channels == tuple(channels("Vector.XYZW"))
    assert candidates("normal", channels("N.XYZ", "Ns.XYZ"))[0].name == "Ns"


def test_order_of_channels_in_the_file_does_not_matter():
    assert candidates("colour", ["B", "G", "R", "A"])[0].channels == ("R", "G", "B")
    assert candidates("normal", ["N.Z", "N.Y", "N.X"])[0].channels == ("N.X", "N.Y", "N.Z")


def test_layers_that_the_user_names():
    names = channels("My.AOV.RGB", "uv.UV", "A.XYZW")
    assert named_layer("albedo", "My.AOV", names, "f").channels == ("My.AOV.R", "My.AOV.G", "My.AOV.B")
    assert named_layer("motion", "A.Z,A.W", names, "f").channels == ("A.Z", "A.W")
    assert parse_layers(["albedo=My.AOV", "motion=A.Z,A.W"]) == {"albedo": "My.AOV", "motion": "A.Z,A.W"}
    for wrong in ("Your.AOV", "My.AOV.R", "A.X,A.Q"):
        with pytest.raises(BadInput, match=r"f has no layer .*it has My\.AOV\.RGB, uv\.UV, A\.XYZW"):
            named_layer("albedo", wrong, names, "f")
    for wrong in ("albedo", "albedo=", "taste=A"):
        with pytest.raises(BadInput, match="QUANTITY=LAYER"):
            parse_layers([wrong])


@given(st.lists(st.text(max_size=12), max_size=8))
def test_any_names_are_possible(names):
    for quantity in QUANTITIES:
        for layer in candidates(quantity, names):
            assert set(layer.channels) <= set(names)
    assert list_layers(names)
