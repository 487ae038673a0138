"""`jaxsand settle`: a height map settles to its angle of repose."""

import argparse
import math
import sys
import time
from io import BytesIO

from jaxsand.cli.files import existing, folder, plausible, progress
from jaxsand.cli.printing import lines, show
from jaxsand.goals.writing import written

SCHEMES = ("relaxation", "pairwise", "super-time-stepping", "multilevel")
_TALLEST = 10  # times a map's side: what is higher or lower than that is no sand


def run_settle(options: argparse.Namespace) -> None:
    """Runs `jaxsand settle`."""
    tell = progress()
    if options.out_file.suffix != ".npy":
        raise ValueError(f"out-file: got {options.out_file}; give a name that ends in .npy")
    from jaxsand.goals import letters

    heights = letters.read_heights(existing(options.input, ".npy"))
    import jax
    import numpy as np

    if heights.dtype == np.float64:
        jax.config.update("jax_enable_x64", True)
    elif heights.dtype.kind != "f":
        heights = heights.astype(np.float32)
    from jaxsand.goals.metrics import volume_error
    from jaxsand.interaction.outcome import OutcomeError, check
    from jaxsand.relaxation import schemes
    from jaxsand.relaxation.settling import settle
    from jaxsand.relaxation.stopping import Outcome, UntilStill
    from jaxsand.scene.boundaries import Walls
    from jaxsand.scene.scene import make_scene

    solid = np.zeros(heights.shape, bool) if options.no_data is None else letters.same(heights, options.no_data)
    if bad := int(np.sum(~np.isfinite(heights[~solid]))):
        raise ValueError(
            f"{options.input}: got {bad} cells that are not finite; fill them first, or have them solid with --no-data nan"
        )
    walls = Walls(jax.numpy.asarray(solid)) if solid.any() else None
    scene = make_scene(heights.shape, options.spacing, math.radians(options.repose_deg), options.neighbours, walls=walls)
    if not solid.all():
        sand = heights[~solid]
        plausible(sand, _TALLEST * options.spacing * max(heights.shape), str(options.input), float(np.median(sand)))
    scheme = getattr(schemes, options.scheme.title().replace("-", ""))()
    stop = UntilStill(options.tol, bound=options.bound)
    folder(options.out_file.parent)
    tell("settling")
    began = time.perf_counter()
    compiled = jax.jit(lambda h: settle(scene, h, scheme=scheme, stop=stop)).lower(heights).compile()
    ready = time.perf_counter()
    settled = jax.block_until_ready(compiled(heights))
    ran = time.perf_counter() - ready
    data = BytesIO()  # numpy itself would not notice a full disk
    np.save(data, np.asarray(settled.height))
    with written(options.out_file) as path:
        path.write_bytes(data.getvalue())
    tell("")
    outcome = Outcome(int(settled.outcome))
    report = {
        "sweeps": int(settled.sweeps),
        "residual": float(settled.residual),
        "volume_error": volume_error(*(np.where(solid, 0, h) for h in (heights, settled.height))),
        "outcome": "clean" if not outcome else (outcome.name or str(int(outcome))).lower(),
        "seconds": ran + ready - began,
        "seconds_compile": ready - began,
        "seconds_run": ran,
        "files": [str(options.out_file)],
    }
    if outcome:
        try:
            check(settled)
        except OutcomeError as error:
            print(f"warning: {error}", file=sys.stderr)
    show(options, report, lines)
