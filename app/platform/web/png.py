"""Matrices as small PNG pictures with a palette, for figures that need no script."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

STOPS = ((24, 16, 66), (56, 44, 128), (40, 92, 150), (28, 138, 138), (86, 182, 98), (196, 212, 64), (253, 236, 150))
"""Colours from low to high; their lightness rises evenly, so that the picture also reads in grey."""


def palette(stops: Sequence[tuple[int, int, int]] = STOPS) -> NDArray[np.uint8]:
    """Compute 255 colours between the stops, [255, 3]."""
    at = np.linspace(0, len(stops) - 1, 255)
    channels = [np.interp(at, np.arange(len(stops)), [stop[c] for stop in stops]) for c in range(3)]
    return np.stack(channels, axis=1).round().astype(np.uint8)


def colour_scale() -> list[list[float | str]]:
    """List the same colours for a chart: [share, colour]."""
    return [[i / (len(STOPS) - 1), "rgb({}, {}, {})".format(*stop)] for i, stop in enumerate(STOPS)]


def picture(values: NDArray[np.floating], low: float, high: float) -> str:
    """Draw the matrix as a `data:` address of a PNG, row 0 at the top; what is not finite is transparent.

    Args:
        values: [rows, columns]. low, high: values of the first and the last colour; beyond them the colours stay.
    """
    share = np.clip((values - low) / ((high - low) or 1.0), 0.0, 1.0)
    known = np.isfinite(values)
    indices = np.where(known, 1 + np.round(254 * np.where(known, share, 0.0)), 0).astype(np.uint8)
    image = Image.fromarray(indices, "P")
    image.putpalette(b"\0\0\0" + palette().tobytes())
    content = io.BytesIO()
    image.save(content, "PNG", transparency=0)
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
