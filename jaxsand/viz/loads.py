"""Animations of a bucket at work: the sand from above, and beside it what the bucket holds."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Bucket
from jaxsand.viz.render import lit

if TYPE_CHECKING:
    from PIL.Image import Image

    from jaxsand.interaction.bucket import Loaded

_INK, _PAPER, _SAND = (30, 30, 40), (250, 249, 246), (204, 168, 112)
_BAR = 84  # pixels beside the map


def save_bucket_animation(
    scene: Scene,
    frames: list[tuple[np.ndarray, float, np.ndarray]],
    path: Path,
    width: int = 420,
    milliseconds: int = 700,
) -> None:
    """Writes a GIF of a bucket at work, its load in litres as a bar beside the map.

    Args:
      scene: grid and bucket.
      frames: for each picture the map [H, W] (m), what the bucket holds then (m^3), and its pose [4] = x, y (m) of the
        middle of its edge, and cos, sin of its heading; NaN where it is not to be drawn. See `bucket_frame`.
      path: the file to write.
      width: pixels of the map's longer side, about.
      milliseconds: between pictures; the last one stays longer.

    Raises:
      ValueError: for no frames, or a scene without a bucket.

    Example:
      >>> import tempfile
      >>> from pathlib import Path
      >>> import numpy as np
      >>> import jaxsand as js
      >>> from jaxsand.viz.loads import save_bucket_animation
      >>> scene = js.make_scene((8, 16), 0.01, tool=js.Bucket(width=0.04, length=0.03, capacity=2e-5))
      >>> with tempfile.TemporaryDirectory() as folder:
      ...     save_bucket_animation(scene, [(np.zeros((8, 16)), 1e-5, np.full(4, np.nan))], Path(folder) / "a.gif")
    """
    _bucket(scene)
    if not frames:
        raise ValueError("frames: got none; give a map, a load and a pose for each picture")
    pictures = [draw_bucket(scene, *frame, width=width).quantize(96) for frame in frames]
    pictures[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=[*[milliseconds] * (len(pictures) - 1), 2000],
        loop=0,
        disposal=1,
    )


def bucket_frame(scene: Scene, loaded: "Loaded") -> tuple[np.ndarray, float, np.ndarray]:
    """A frame for `save_bucket_animation` from what `scoop` or `dump` returned."""
    from jaxsand.interaction.bucket import load_volume

    pose = loaded.pose
    return (
        np.asarray(loaded.height),
        float(load_volume(scene, loaded.load)),
        np.array([float(x) for x in (pose.x, pose.y, pose.cos, pose.sin)]),
    )


def draw_bucket(scene: Scene, height: np.ndarray, load: float, pose: np.ndarray, *, width: int = 420) -> "Image":
    """The map [H, W] (m) with the bucket at its pose [4], and beside it a bar, full at the bucket's capacity (m^3)."""
    import PIL.Image
    import PIL.ImageDraw

    bucket = _bucket(scene)
    rows, columns = height.shape
    dx, zoom = float(scene.grid.spacing), max(1, round(width / max(rows, columns)))
    picture = np.flipud((lit(height, dx)[..., :3] * 255).astype(np.uint8))
    sand = PIL.Image.fromarray(picture).resize((columns * zoom, rows * zoom), PIL.Image.Resampling.BICUBIC)
    tall = max(rows * zoom, 120)
    image = PIL.Image.new("RGB", (columns * zoom + _BAR, tall), _PAPER)
    image.paste(sand, (0, 0))
    draw = PIL.ImageDraw.Draw(image)
    if np.all(np.isfinite(pose)):
        corners = _outline(bucket, pose) / dx * zoom
        corners[:, 1] = rows * zoom - corners[:, 1]
        draw.polygon([tuple(c) for c in corners], outline=_INK, fill=(70, 80, 95))
        draw.line([tuple(c) for c in corners[:2]], fill=(230, 120, 30), width=3)  # its edge
    left, top, bottom = columns * zoom + 26, 30, tall - 34
    share = min(max(load / float(bucket.capacity), 0.0), 1.0)
    draw.rectangle((left, bottom - share * (bottom - top), left + 32, bottom), fill=_SAND)
    draw.rectangle((left, top, left + 32, bottom), outline=_INK, width=2)
    draw.text((left + 16, top - 12), f"{100 * share:.0f}%", fill=_INK, anchor="mm")
    draw.text((left + 16, bottom + 16), f"{1e3 * load:.3f} l", fill=_INK, anchor="mm")
    return image


def _bucket(scene: Scene) -> Bucket:
    """The scene's bucket; raises ValueError if it has none."""
    if not isinstance(scene.tool, Bucket):
        raise ValueError(f"scene.tool: got {type(scene.tool).__name__}; give make_scene(..., tool=Bucket(...))")
    return scene.tool


def _outline(bucket: Bucket, pose: np.ndarray) -> np.ndarray:
    """The corners [4, 2] = x, y (m) of a bucket whose edge is at a pose: the edge's ends first."""
    x, y, cos, sin = pose
    wide, length = float(bucket.width) / 2, float(bucket.length)
    corners = np.array([(0, wide), (0, -wide), (-length, -wide), (-length, wide)])
    return np.stack([x + corners @ [cos, -sin], y + corners @ [sin, cos]], axis=1)
