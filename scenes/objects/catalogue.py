"""Makers of all things that stand on the floor, and of all that stand on those. Rooms draw from them in this order."""

from scenes.objects import decor, fittings, furniture, glazing, plants, seating
from scenes.objects.thing import Maker


def by_name(*makers: Maker) -> dict[str, Maker]:
    """The makers, called make_NAME, by that name."""
    return {maker.__name__.removeprefix("make_"): maker for maker in makers}


FURNITURE = by_name(
    furniture.make_table,
    seating.make_chair,
    seating.make_stool,
    seating.make_bench,
    seating.make_sofa,
    seating.make_armchair,
    seating.make_bed,
    furniture.make_shelf,
    furniture.make_cabinet,
    furniture.make_desk,
    furniture.make_screen,
    plants.make_floor_plant,
    fittings.make_floor_lamp,
    furniture.make_column,
)

DECOR = by_name(
    decor.make_vase,
    decor.make_bowl,
    decor.make_bottle,
    decor.make_cup,
    decor.make_glass,
    decor.make_books,
    decor.make_book_row,
    decor.make_box,
    decor.make_ball,
    decor.make_ring,
    decor.make_lump,
    decor.make_crystal,
    decor.make_candle,
    plants.make_small_plant,
    decor.make_basket,
    fittings.make_photo,
)

GLAZING = by_name(glazing.make_showcase, glazing.make_pane)
