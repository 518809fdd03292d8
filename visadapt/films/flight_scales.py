"""What the panels of a film of flights share: one set of scales, and how a path and the ground are drawn to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D

from visadapt.evaluation.scoring import FAR
from visadapt.films import widgets
from visadapt.films.flight_panel import FlightPanel
from visadapt.films.widgets import AMBER, RED, TEAL, Floats

Seen = Callable[[Floats], Floats]
"""Points (..., 3) in m to where they are seen (..., 2)."""
ERROR_COLOURS = LinearSegmentedColormap.from_list("error", [TEAL, AMBER, RED])


class FlightScales:
    """The scales of flights that are filmed side by side.

    Raises:
        ValueError: flights along a reference beside flights through a point.
    """

    def __init__(self, panels: Sequence[FlightPanel]) -> None:
        if len({panel.follows for panel in panels}) > 1:
            raise ValueError("flights along a reference and through a point share no scales: film them apart")
        self.follows = panels[0].follows
        """whether the flights follow a reference, or else fly through a point"""
        # These scales fit the flights that did not fail, so that these stay legible.
        worst = max([panel.worst for panel in panels if panel.failed is None] or [FAR])
        self.far = max(widgets.ceiling(worst), 0.05)
        """m, distance at the top of the chart; from half of it on a path is drawn red"""
        self.box = min(max(1.2 * worst, 0.1), FAR)
        """m, half the width of the magnified view"""
        self.most_force = max(*(float(np.linalg.norm(panel.force, axis=1).max()) for panel in panels), 0.1)
        """N"""
        low = min(float(panel.reference[:, 2].min()) for panel in panels)
        self.ground = float(np.floor(2 * low - 1.4) / 2) if self.follows else float(np.floor(low - 6.0))
        """m, height of the ground that is drawn"""

    def path(self, axes: Axes, panel: FlightPanel) -> Callable[[Seen, int], object]:
        """The path, coloured by its distance from the reference, or by how far off it passes the point."""
        colours = self.colours(panel.away if self.follows else np.full(len(panel.times), panel.worst))
        pieces = np.stack([panel.position[:-1], panel.position[1:]], 1)
        lines = LineCollection([], linewidths=3, capstyle="round", animated=True, zorder=2)
        axes.add_collection(lines, autolim=False)
        return lambda seen, i: lines.set(segments=seen(pieces[:i]), colors=colours[:i])

    def colours(self, away: Any) -> Any:
        """Colours of a path at distances in m from its course."""
        return ERROR_COLOURS(2 * away / self.far)

    def dropped(self, points: Floats) -> Floats:
        """Points (..., 3) moved straight down, or up, to the ground."""
        return np.where([True, True, False], points, self.ground)

    def plumb(self, point: Floats) -> Floats:
        """(2, 3), from a point to the ground."""
        return np.stack([point, self.dropped(point)])


def moving_line(axes: Axes, colour: str, width: float, **properties: Any) -> Line2D:
    """A line that moves, with no points yet."""
    return axes.plot([], [], color=colour, linewidth=width, animated=True, **properties)[0]
