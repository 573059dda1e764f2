"""Drawing of a structure: points, the degrees of freedom that move them, and the lines between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from monitor.core import DIRECTION_WORDS, Array, ComplexArray, Settings
from monitor.model.structures.building import Building

_FRAME_WIDTH = 0.4
"""Width of a drawn frame over its height. [ratio; judgement]"""

_BUILDING_WIDTH = 0.4
"""Longest side of a drawn building's plan over its height. [ratio; judgement]"""
_ELEVATION_WIDTH = 0.36
"""Width of a building's drawn elevations over its height. [ratio; measured on pictures: a loss in words fits in]"""
_MOST_STOREYS = 13
"""Most storeys that are numbered beside a building's elevations. [count; measured on pictures: labels do not overlap]"""
_BUILDING_TURN = np.radians(-30.0)
"""Angle by which a drawn building is turned, so that both directions are seen from the front. [rad; judgement]"""

Dof = Annotated[int, Field(ge=1)] | None


class NodeTable(Settings):
    """``[[nodes]]``: one point of the structure's drawing; nodes are numbered from 1 in the file's order."""

    name: str = ""
    """Name that the drawing shows."""
    x: float = Field(default=0.0, allow_inf_nan=False)
    """Coordinate along the structure, m."""
    y: float = Field(default=0.0, allow_inf_nan=False)
    """Coordinate across, m."""
    z: float = Field(default=0.0, allow_inf_nan=False)
    """Coordinate upwards, m."""
    dof_x: Dof = None
    """Degree of freedom (floor), from 1, that moves the node along x; none: it does not move that way."""
    dof_y: Dof = None
    """The same along y."""
    dof_z: Dof = None
    """The same along z."""


class LineTable(Settings):
    """``[[lines]]``: one member of the structure's drawing."""

    nodes: tuple[int, int]
    """Numbers of the nodes at its ends, from 1."""
    story: int | None = None
    """Stiffness, from 1, whose loss colours it; grey by default."""


@dataclass(frozen=True, eq=False, slots=True)
class Drawing:
    """Points of a structure, the degrees of freedom that move them, and the lines between them."""

    points: Annotated[Array, "n 3"]
    """m."""
    dofs: Annotated[NDArray[np.intp], "n 3"]
    """Degree of freedom that moves each point along x, y and z, from 0; -1 for none."""
    lines: Annotated[NDArray[np.intp], "l 2"]
    """Points at the ends of each line, from 0."""
    stories: Annotated[NDArray[np.intp], "l"]
    """Story of each line, from 0; -1 for none."""
    names: tuple[str, ...] = ()
    """Name of each point; empty for none."""
    motion: Annotated[Array, "n 3 N"] | None = None
    """Motion of each point by the degrees of freedom, where floors turn; None: that of `dofs`."""
    beside: int = 0
    """Number of the last lines: elevations beside the structure, which do not move."""

    def displaced(self, whole: Annotated[ComplexArray, "N"]) -> Annotated[ComplexArray, "n 3"]:
        """Compute the points' displacements by those of the degrees of freedom."""
        if self.motion is not None:
            return np.asarray(self.motion @ whole)
        return np.where(self.dofs >= 0, whole[self.dofs], 0.0)

    @classmethod
    def of(cls, nodes: Sequence[NodeTable], lines: Sequence[LineTable]) -> Self:
        """Make the drawing of the tables of a structure file."""
        return cls(
            np.array([(n.x, n.y, n.z) for n in nodes], dtype=float),
            np.array([(n.dof_x or 0, n.dof_y or 0, n.dof_z or 0) for n in nodes], dtype=np.intp) - 1,
            np.array([line.nodes for line in lines], dtype=np.intp) - 1,
            np.array([line.story or 0 for line in lines], dtype=np.intp) - 1,
            tuple(n.name for n in nodes),
        )

    @classmethod
    def of_frame(cls, story_heights_m: Array) -> Self:
        """Make the drawing of a frame with four columns a story, the top one first; only the heights' proportions matter."""
        levels = np.append(np.cumsum(story_heights_m[::-1])[::-1], 0.0)  # of floor 1 (top) .. n, and of the ground
        n, width = len(story_heights_m), _FRAME_WIDTH * levels[0]
        points = np.array([(x, y, z) for z in levels for x, y in ((0, 0), (width, 0), (width, width), (0, width))])
        dofs = np.full((len(points), 3), -1, dtype=np.intp)
        dofs[: 4 * n, 0] = np.repeat(np.arange(n), 4)
        columns = [(4 * j + c, 4 * j + 4 + c) for j in range(n) for c in range(4)]
        edges = [(4 * i + c, 4 * i + (c + 1) % 4) for i in range(n + 1) for c in range(4)]
        stories = np.append(np.repeat(np.arange(n), 4), np.full(len(edges), -1)).astype(np.intp)
        return cls(points, dofs, np.array([*columns, *edges], dtype=np.intp), stories)

    @classmethod
    def of_building(cls, structure: Building, story_heights_m: Array) -> Self:
        """Make the drawing of a building, the lowest storey first.

        Each storey has braces in the faces along x and along y, which stand for its stiffnesses, and a line in the middle for
        that about z; a building that moves one way has the braces of that way.  At its left stands an elevation for each
        direction, whose columns are the stiffnesses once more, under its name; the storeys are numbered.  Names hang below
        their points.
        """
        n, levels = len(story_heights_m), np.append(0.0, np.cumsum(story_heights_m))
        half, height = 0.5 * structure.plan_m[[0, *range(n)]], float(levels[-1])
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)])  # and the middle
        at = corners * half[:, None]
        cos, sin = np.cos(_BUILDING_TURN), np.sin(_BUILDING_TURN)
        turn = np.array([[cos, -sin], [sin, cos]])
        flat = at @ turn.T * (_BUILDING_WIDTH * height / structure.plan_m.max())
        body = np.concatenate([flat, np.broadcast_to(levels[:, None, None], (n + 1, 5, 1))], axis=2).reshape(-1, 3)
        lines, stories = list[tuple[int, int]](), list[int]()
        faces = {"x": ((0, 1), (3, 2)), "y": ((0, 3), (1, 2)), "torsion": ((4, 4),)}
        for i, d in enumerate(structure.directions):
            for j in range(n):
                lines += [(5 * j + a, 5 * j + 5 + b) for a, b in faces[d]]
                stories += [i * n + j] * len(faces[d])
        lines += [(5 * j + c, 5 * j + 5 + c) for j in range(n) for c in range(4)]
        lines += [(5 * i + c, 5 * i + (c + 1) % 4) for i in range(n + 1) for c in range(4)]
        stories += [-1] * (len(lines) - len(stories))
        of_body, sides, named = len(lines), list[tuple[float, float, float]](), dict[str, tuple[float, float, float]]()
        for i, d in enumerate(structure.directions):
            first, right = (
                len(body) + len(sides),
                body[:, 0].min() - (0.1 + 0.42 * (len(structure.directions) - 1 - i)) * height,
            )
            sides += [(x, 0.0, z) for z in levels.tolist() for x in (right - _ELEVATION_WIDTH * height, right)]
            lines += [(first + c, first + c + 2) for c in range(2 * n)]
            lines += [(first + 2 * j, first + 2 * j + 1) for j in range(n + 1)]
            stories += [*np.repeat(i * n + np.arange(n), 2).tolist(), *[-1] * (n + 1)]
            named[DIRECTION_WORDS[d]] = (right - 0.5 * _ELEVATION_WIDTH * height, 0.0, 1.1 * height)
        numbered = range(0, n, -(-n // _MOST_STOREYS))
        named |= {f"storey {j + 1}": (sides[0][0] - 0.16 * height, 0.0, levels[j + 1]) for j in numbered}
        points = np.concatenate([body, sides, list(named.values())])
        motion = np.zeros((len(points), 3, structure.n_dofs))
        on = structure.points_motion(np.repeat(np.arange(n + 1), 5).tolist(), at.reshape(-1, 2))
        motion[: len(body), :2] = turn @ on
        dofs = np.where(motion.any(axis=2), np.abs(motion).argmax(axis=2), -1)
        names = (*[""] * (len(body) + len(sides)), *named)
        members = np.array(lines, dtype=np.intp), np.array(stories, dtype=np.intp)
        return cls(points, dofs, *members, names, motion, len(lines) - of_body)

    @classmethod
    def of_bars(cls, n_stories: int) -> Self:
        """Make a list of bars, one for each stiffness, of a structure whose form is not known; no motion is drawn of it."""
        ends = [(x, 0.0, -0.5 * j) for j in range(n_stories) for x in (0.0, 1.0)]
        index = np.arange(n_stories, dtype=np.intp)
        none = np.full((2 * n_stories, 3), -1, dtype=np.intp)
        return cls(np.array(ends), none, np.stack([2 * index, 2 * index + 1], axis=1), index)

    @classmethod
    def of_channels(cls, names: Sequence[str]) -> Self:
        """Make a row of points, the first channel on top, each of which moves with its channel: their places are not known."""
        n_channels = len(names)
        points = np.zeros((n_channels, 3))
        points[:, 2] = np.arange(n_channels)[::-1]
        dofs = np.full((n_channels, 3), -1, dtype=np.intp)
        dofs[:, 0] = np.arange(n_channels)
        between = np.arange(n_channels - 1, dtype=np.intp)
        none = np.full(n_channels - 1, -1, dtype=np.intp)
        return cls(points, dofs, np.stack([between, between + 1], axis=1), none, tuple(names))


def drawing_problems(nodes: Sequence[NodeTable], lines: Sequence[LineTable], n_dofs: int, n_stories: int) -> list[str]:
    """List what is wrong with the tables of a drawing of a structure; nothing where there are none."""
    problems = []
    for i, node in enumerate(nodes, start=1):
        for axis in ("dof_x", "dof_y", "dof_z"):
            if (dof := getattr(node, axis)) is not None and dof > n_dofs:
                problems.append(f"nodes: node {i} has {axis} = {dof} of {n_dofs} degrees of freedom")
    for i, line in enumerate(lines, start=1):
        problems += [
            f"lines: line {i} ends at node {k} of {len(nodes)}" for k in line.nodes if not 1 <= k <= len(nodes)
        ]
        if line.story is not None and not 1 <= line.story <= n_stories:
            problems.append(f"lines: line {i} has story = {line.story} of {n_stories}")
    missing = sorted({*range(1, n_stories + 1)} - {line.story for line in lines if line.story})
    if missing and (nodes or lines):
        problems.append(f"lines: no line has story = {', '.join(map(str, missing))}, so its loss would not be drawn")
    return problems
