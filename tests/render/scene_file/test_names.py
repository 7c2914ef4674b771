"""Every name once, and none that Mitsuba reserves."""

from hypothesis import given
from hypothesis import strategies as st

from render.scene_file.stand_ins import RESERVED_NAMES, Names


@given(st.lists(st.sampled_from(["a", "a-2", "a-3", "a.b", "a_b", "", "type", "sky", "sky-2"])))
def test_names_are_given_once(wanted):
    names = Names()
    given = [names.unique(name) for name in wanted]
    assert len(set(given)) == len(given) and not set(given) & set(RESERVED_NAMES)
    assert not any("." in name or not name for name in given)


def test_the_first_keeps_its_name():
    names = Names()
    assert [names.unique("ball") for _ in range(3)] == ["ball", "ball-2", "ball-3"]
    assert names.unique("größe 1") == "größe 1" and names.unique("sky") == "sky-2"
