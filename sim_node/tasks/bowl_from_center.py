"""Put the bowl that stands in the middle of the table onto the plate: libero_spatial 2."""

from __future__ import annotations

from sim_node.libero.starts import Place
from sim_node.tasks.bowl_on_plate import (
    BOWL,
    MAX_BOWL_SHIFT_M,
    MAX_PLATE_SHIFT_M,
    PLATE,
    BowlOnPlate,
)

TASK = BowlOnPlate(
    name="bowl_from_center",
    number=2,
    problem="pick_up_the_black_bowl_from_table_center_and_place_it_on_the_plate",
    places={
        # The official states of this problem have the bowl at one x.
        BOWL: Place(-0.075, 0.0, half_x_m=0.0, max_shift_m=MAX_BOWL_SHIFT_M),
        "akita_black_bowl_2": Place(0.01, 0.31),
        "cookies_1": Place(0.07, 0.03),
        "glazed_rim_porcelain_ramekin_1": Place(-0.20, 0.20),
        PLATE: Place(0.06, 0.20, max_shift_m=MAX_PLATE_SHIFT_M),
    },
)
