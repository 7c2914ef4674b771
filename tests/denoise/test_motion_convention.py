"""Every convention of motion vectors is detected, and doubt is reported."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from denoise.analysis import blurred
from denoise.motion_convention import PAIR_COMPONENTS, SIGNS, UNITS, ConventionDetector, MotionConvention, conventions
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from tests.helpers.foreign import image

HEIGHT, WIDTH = 90, 160


def encoded_as(
    convention: MotionConvention, to_previous: np.ndarray, to_next: np.ndarray, components: int
) -> np.ndarray:
    """Vectors in a renderer's convention; the other pair has those to the next frame."""
    size = {"pixels": (1, 1), "fractions": (WIDTH, HEIGHT), "half-fractions": (WIDTH / 2, HEIGHT / 2)}[convention.unit]
    scale = [SIGNS[convention.x], SIGNS[convention.y]] / np.array(size)
    vectors = np.zeros((HEIGHT, WIDTH, components))
    vectors[..., PAIR_COMPONENTS[convention.pair]] = to_previous * scale
    if components == 4:
        vectors[..., PAIR_COMPONENTS["ZW" if convention.pair == "XY" else "XY"]] = to_next * scale
    return vectors.astype(np.float32)


@pytest.fixture(scope="module")
def moving():
    """Guides of three frames and the middle one's motion to the first and to the last, which are different."""
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    texture = rng.random((HEIGHT + 60, WIDTH + 60, 3), np.float32)

    def shifted(dx: int, dy: int) -> np.ndarray:
        return blurred(np.ascontiguousarray(texture[rows + 30 + dy, columns + 30 + dx]))

    to_previous = np.broadcast_to([5.0, 3.0], (HEIGHT, WIDTH, 2))
    return shifted(-5, -3), shifted(0, 0), to_previous, np.broadcast_to([-4.0, 9.0], (HEIGHT, WIDTH, 2))


@pytest.mark.parametrize("components", [2, 4])
def test_every_convention_is_detected(moving, components):
    before, now, to_previous, to_next = moving
    tried = conventions(components)
    assert len(tried) == 12 * components // 2
    for convention in tried:
        detector = ConventionDetector(components)
        detector.add(now, before, encoded_as(convention, to_previous, to_next, components))
        detection = detector.detection()
        assert detection.convention == convention and detection.certain, detection.reason
        assert str(convention) in detection.reason


def guides(index: int) -> np.ndarray:
    frame = synthetic_frame(index, HEIGHT, WIDTH)
    return blurred(np.concatenate([image(frame, "albedo"), image(frame, "normal")], axis=-1).astype(np.float32))


def test_moving_objects_before_a_moving_camera():
    for text in ("XY,+x,+y,pixels", "XY,-x,+y,pixels", "XY,+x,-y,fractions"):
        convention = MotionConvention.parse(text)
        detector = ConventionDetector(2)
        for index in (1, 2, 3):
            motion = image(synthetic_frame(index, HEIGHT, WIDTH), "motion")
            detector.add(guides(index), guides(index - 1), encoded_as(convention, motion, motion, 2))
        assert detector.detection().convention == convention


def test_steady_motion_is_read_from_the_first_pair():
    texture = np.random.default_rng(2).random((HEIGHT, 2 * WIDTH, 3), np.float32)
    now, before = (blurred(np.ascontiguousarray(texture[:, start : start + WIDTH])) for start in (10, 6))
    step = np.broadcast_to([4.0, 0.0], (HEIGHT, WIDTH, 2))
    detector = ConventionDetector(4)
    detector.add(now, before, encoded_as(MotionConvention("XY", "+", "-"), step, -step, 4))
    detection = detector.detection()
    assert detection.convention.pair == "XY" and detection.convention.x == "+"
    assert not detection.certain  # nothing moves up or down


def test_no_motion_and_random_motion_are_uncertain():
    still = guides(0)
    detector = ConventionDetector(2)
    detector.add(still, still, np.zeros((HEIGHT, WIDTH, 2), np.float32))
    assert detector.detection() == replace(detector.detection(), convention=MotionConvention(), certain=False)
    assert "nothing moves" in detector.detection().reason
    detector.add(guides(20), still, np.random.default_rng(3).normal(0, 20, (HEIGHT, WIDTH, 2)).astype(np.float32))
    assert not detector.detection().certain and "no convention warps well" in detector.detection().reason


@given(st.sampled_from(conventions(4)))
def test_parsing_inverts_str(convention):
    assert MotionConvention.parse(str(convention)) == convention


def test_other_texts_are_refused():
    for text in ("", "XY", "XY,+x,+y,inches", "AB,+x,+y,pixels"):
        with pytest.raises(BadInput, match=", ".join(UNITS)):
            MotionConvention.parse(text)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1)])
def test_tiny_images_and_nan(size):
    detector = ConventionDetector(4)
    motion = np.full((*size, 4), np.nan, np.float32)
    motion[..., 1] = np.inf
    motion[..., 2] = 1e30
    guide = np.ones((*size, 3), np.float32)
    detector.add(guide, guide, motion)
    assert np.isfinite(detector.detection().convention.pixels(motion)).all()
