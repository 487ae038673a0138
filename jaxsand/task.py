"""Where goals lie on a map, and how near sand comes to them. The same as `jaxsand.goals.metrics`."""

from jaxsand.goals.metrics import (
    GLYPH_SQUARE,
    below,
    cell_centre,
    dug,
    finite,
    fits,
    fits_where_it_counts,
    iou,
    l2,
    l2_reduction,
    map_goal,
    place,
    resample,
    volume_error,
)

__all__ = [
    "GLYPH_SQUARE",
    "below",
    "cell_centre",
    "dug",
    "finite",
    "fits",
    "fits_where_it_counts",
    "iou",
    "l2",
    "l2_reduction",
    "map_goal",
    "place",
    "resample",
    "volume_error",
]
