"""All things that stand on the floor, and all that stand on those, by name. Rooms draw from them by their order."""

from scenes.objects.books import make_book_row, make_books
from scenes.objects.furniture import make_cabinet, make_column, make_desk, make_screen, make_shelf, make_table
from scenes.objects.lamps import make_floor_lamp
from scenes.objects.pictures import make_photo
from scenes.objects.plants import make_floor_plant, make_small_plant
from scenes.objects.seating import make_armchair, make_bed, make_bench, make_chair, make_sofa, make_stool
from scenes.objects.solids import make_ball, make_box, make_crystal, make_lump, make_ring
from scenes.objects.tableware import (
    make_basket,
    make_bottle,
    make_bowl,
    make_candle,
    make_cup,
    make_glass,
    make_vase,
)
from scenes.objects.thing import Maker

FURNITURE: dict[str, Maker] = {
    "table": make_table,
    "chair": make_chair,
    "stool": make_stool,
    "bench": make_bench,
    "sofa": make_sofa,
    "armchair": make_armchair,
    "bed": make_bed,
    "shelf": make_shelf,
    "cabinet": make_cabinet,
    "desk": make_desk,
    "screen": make_screen,
    "floor_plant": make_floor_plant,
    "floor_lamp": make_floor_lamp,
    "column": make_column,
}

DECOR: dict[str, Maker] = {
    "vase": make_vase,
    "bowl": make_bowl,
    "bottle": make_bottle,
    "cup": make_cup,
    "glass": make_glass,
    "books": make_books,
    "book_row": make_book_row,
    "box": make_box,
    "ball": make_ball,
    "ring": make_ring,
    "lump": make_lump,
    "crystal": make_crystal,
    "candle": make_candle,
    "small_plant": make_small_plant,
    "basket": make_basket,
    "photo": make_photo,
}
