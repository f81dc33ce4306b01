# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Sheets for the installer as PDF, A4 or A3: plan and elevations to scale, views, materials."""

from collections.abc import Iterator, Sequence
import io
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.bill import BILL_COLUMNS, bill_rows
from ocp_ros.report.camera_words import camera_colour, lens_text
from ocp_ros.report.drawing.assessment_pictures import (
    corners_of_plan,
    draw_axes,
    draw_distances,
    draw_marks,
)
from ocp_ros.report.drawing.depth_image import depth_colours, depth_image
from ocp_ros.report.drawing.plan_drawing import darkened, reach
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.saved_pictures import draw_table, fonts_for_all_letters, write
from ocp_ros.report.facts import (
    page_facts_of,
    PageFacts,
    percent,
    REGION_COLUMNS,
    REQUIREMENT_COLUMNS,
)
from ocp_ros.report.wall_lines import wall_lines
from ocp_ros.report.wall_references import InnerWall, ReferenceWall
from ocp_ros.rig.structure import MAX_MOUNT_GAP_M
from ocp_ros.util.files import write_atomically

#: Width and height of sheets in landscape, inches.
PAPERS = {'A4': (11.69, 8.27), 'A3': (16.54, 11.69)}
#: Scales of drawings: metres in the room for a metre on the sheet.
SCALES = (10, 20, 25, 50, 75, 100, 150, 200, 250, 500, 1000, 2000)
INCHES_PER_M = 1000.0 / 25.4
MARGIN = 0.5
#: Height of the title above the drawings and of the line below them, inches.
HEAD, FOOT = 0.6, 0.25
#: Space for dimensions and letters around a drawing, inches.
BORDER = 0.75
#: Points within this distance of a wall are drawn in its elevation, metres.
WALL_M = 0.15


class Box(NamedTuple):
    """Left edge, lower edge, width and height of a part of a sheet, inches."""

    left: float
    bottom: float
    width: float
    height: float


class Elevation(NamedTuple):
    """
    A wall that carries cameras, seen from inside.

    :ivar wall: the wall.
    :ivar along: (2,) unit vector to the right along the wall, map frame.
    :ivar start: the left end of the wall along this vector, metres.
    :ivar length: metres.
    :ivar cameras: the numbers of its cameras, from 0.
    """

    wall: ReferenceWall | InnerWall
    along: np.ndarray
    start: float
    length: float
    cameras: list[int]


def write_sheets(path: Path, assessed: Assessment, paper: str) -> None:
    """
    Write the sheets of a placement as one PDF file.

    :param paper: a key of :data:`PAPERS`.
    """
    content = io.BytesIO()
    with fonts_for_all_letters(), PdfPages(content) as pages:
        for figure in sheets_of(assessed, PAPERS[paper]):
            pages.savefig(figure)
    write_atomically(path, content.getvalue())


def sheets_of(assessed: Assessment, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield the sheets of a size in inches: plan, elevations, views of cameras, materials."""
    facts = page_facts_of(assessed)
    yield _plan_sheet(assessed, facts, size)
    elevations = elevations_of(assessed)
    for first in range(0, len(elevations), 2):
        yield _elevation_sheet(assessed, facts, size, elevations[first:first + 2])
    cameras = len(assessed.placement.cameras)
    for first in range(0, cameras, 6):
        yield _view_sheet(assessed, facts, size, range(first, min(first + 6, cameras)))
    for first in range(0, cameras, 24):
        yield _material_sheet(assessed, facts, size, range(first, min(first + 24, cameras)))


def scale_for(size_m: Sequence[float], box: Box) -> int:
    """Return the scale at which a width and a height, metres, fit into a box without border."""
    for scale in SCALES:
        width, height = np.array(size_m) * INCHES_PER_M / scale
        if width <= box.width - 2.0 * BORDER and height <= box.height - 2.0 * BORDER:
            return scale
    return SCALES[-1]


def elevations_of(assessed: Assessment) -> list[Elevation]:
    """Return the walls that carry cameras, in the order of their letters."""
    found: dict[str, Elevation] = {}
    known: list[ReferenceWall | InnerWall] = [*assessed.walls, *assessed.references.inner]
    walls = {wall.letter: wall for wall in known}
    points = assessed.scene.points[:, :2].astype(np.float64)
    for number, distances in enumerate(assessed.references.distances):
        if not distances or distances[0].metres > MAX_MOUNT_GAP_M:
            continue
        wall = walls[distances[0].letter]
        if wall.letter not in found:
            # To the right of an observer who looks outwards.
            along = np.array([wall.outward[1], -wall.outward[0]])
            if isinstance(wall, ReferenceWall):
                # The sides follow each other clockwise: each ends at the next one to its right.
                end = assessed.walls[('ABCD'.index(wall.letter) + 1) % 4].offset
                start = end - wall.length
            else:
                on_wall = points[np.abs(points @ wall.outward - wall.offset) <= WALL_M] @ along
                start, end = on_wall.min(), on_wall.max()
            found[wall.letter] = Elevation(wall, along, float(start), float(end - start), [])
        found[wall.letter].cameras.append(number)
    return [found[letter] for letter in sorted(found, key=lambda text: (len(text), text))]


def _empty_sheet(facts: PageFacts, size: tuple[float, float], title: str) -> tuple[Figure, Box]:
    """Return a sheet with its title and the line below, and the box for the drawings."""
    figure = Figure(figsize=size, facecolor='white')
    width = size[0] - 2.0 * MARGIN
    write(figure, (MARGIN, size[1] - 0.5), f'{facts.title} - {title}', 0.7 * width, 13, INK,
          bold=True)
    write(figure, (MARGIN, size[1] - 0.72), facts.subtitle, width, 8, PALE_INK)
    write(figure, (MARGIN, 0.3), facts.origin, width, 6.2, PALE_INK)
    return figure, Box(MARGIN, 0.3 + FOOT, width, size[1] - 2.0 * MARGIN - HEAD - FOOT + 0.2)


def _axes_to_scale(figure: Figure, box: Box, centre: np.ndarray, scale: int) -> Axes:
    """Add axes that fill a box, to scale, around a centre (2,) in metres."""
    axes = figure.add_axes(np.array(box) / np.tile(figure.get_size_inches(), 2))
    half = 0.5 * np.array([box.width, box.height]) * scale / INCHES_PER_M
    axes.set(xlim=(centre[0] - half[0], centre[0] + half[0]),
             ylim=(centre[1] - half[1], centre[1] + half[1]))
    axes.spines[:].set_visible(False)
    return axes


def _plan_sheet(assessed: Assessment, facts: PageFacts, size: tuple[float, float]) -> Figure:
    """Return the sheet with the floor plan, wall A at the top."""
    corners = corners_of_plan(assessed)
    # The title does not change the space for the drawing.
    _, box = _empty_sheet(facts, size, '')
    scale = scale_for(corners[1] - corners[0], box)
    figure, _ = _empty_sheet(facts, size, f'Plan 1 : {scale}')
    axes = _axes_to_scale(figure, box, corners.mean(axis=0), scale)
    rotation = assessed.plan_rotation[:2, :2]
    heights = assessed.scene.bounds[:, 2].tolist()
    for number, placed in enumerate(assessed.placement.cameras):
        seen = reach(placed.camera.model, placed.pose, heights) @ rotation.T
        axes.fill(*np.clip(seen, corners[0], corners[1]).T, color=camera_colour(number), alpha=0.1,
                  linewidth=0.0, zorder=1)
    for line in wall_lines(assessed.scene):
        axes.plot(*(line @ rotation.T).T, color=INK, linewidth=1.6, zorder=3)
    draw_distances(axes, assessed)
    draw_axes(axes, assessed, 0.4 * scale / INCHES_PER_M)
    draw_marks(axes, assessed, 1.2)
    # Beyond the letters of the walls.
    gap = 0.68 * scale / INCHES_PER_M
    (left, bottom), (right, top) = corners
    _draw_dimension(axes, np.array([[left, bottom - gap], [right, bottom - gap]]))
    _draw_dimension(axes, np.array([[right + gap, bottom], [right + gap, top]]))
    axes.set_xticks([])
    axes.set_yticks([])
    _draw_bar(axes, scale)
    return figure


def _draw_bar(axes: Axes, scale: int) -> None:
    """Draw a bar of a round length in the lower left corner, to check the scale of a print."""
    length = next(one for one in (0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0) if one >= 0.013 * scale)
    left, bottom = axes.get_xlim()[0], axes.get_ylim()[0] + 0.12 * scale / INCHES_PER_M
    axes.plot([left, left + length], [bottom, bottom], color=INK, linewidth=2.5,
              solid_capstyle='butt', clip_on=False)
    axes.text(left, bottom + 0.06 * scale / INCHES_PER_M, f'{length:g} m; print at 100 %',
              fontsize=7, color=INK, va='bottom')


def _draw_dimension(axes: Axes, ends: np.ndarray) -> None:
    """Draw the length of a line (2, 2), metres, as an arrow with two heads."""
    axes.annotate('', ends[1], ends[0], annotation_clip=False, arrowprops={
        'arrowstyle': '<|-|>', 'color': INK, 'linewidth': 0.7, 'shrinkA': 0.0, 'shrinkB': 0.0,
        'mutation_scale': 7})
    angle = np.rad2deg(np.arctan2(*(ends[1] - ends[0])[::-1]))
    x, y = ends.mean(axis=0)
    axes.text(x, y, f'{np.linalg.norm(ends[1] - ends[0]):.2f} m', fontsize=7.5,
              color=INK, ha='center', va='center', rotation=(angle + 90.0) % 180.0 - 90.0,
              bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0}, zorder=7)


def _elevation_sheet(assessed: Assessment, facts: PageFacts, size: tuple[float, float],
                     elevations: Sequence[Elevation]) -> Figure:
    """Return the sheet of one or two walls that carry cameras, one above the other."""
    floor, ceiling = assessed.floors.height, float(assessed.scene.bounds[1, 2])
    _, whole = _empty_sheet(facts, size, '')
    height = whole.height / len(elevations)
    boxes = [whole._replace(bottom=whole.bottom + height * (len(elevations) - 1 - k),
                            height=height) for k in range(len(elevations))]
    scale = max(scale_for((one.length, ceiling - floor), box)
                for one, box in zip(elevations, boxes))
    letters = ' and '.join(one.wall.letter for one in elevations)
    figure, _ = _empty_sheet(facts, size, f'Wall {letters} from inside, 1 : {scale}')
    for one, box in zip(elevations, boxes):
        centre = np.array([0.5 * one.length, 0.5 * (ceiling - floor)])
        _draw_elevation(_axes_to_scale(figure, box, centre, scale), assessed, one,
                        ceiling - floor)
    _draw_bar(figure.axes[-1], scale)
    return figure


def _draw_elevation(axes: Axes, assessed: Assessment, one: Elevation, height: float) -> None:
    """Draw a wall with its points, its cameras and their distances from the floor and an end."""
    floor = assessed.floors.height
    points = assessed.scene.points.astype(np.float64)
    near = np.abs(points[:, :2] @ one.wall.outward - one.wall.offset) <= WALL_M
    positions = np.column_stack([points[near, :2] @ one.along - one.start,
                                 points[near, 2] - floor])
    axes.plot(*positions[:: max(1, len(positions) // 4000)].T, '.', color='#c9ced3',
              markersize=1.2, zorder=1, rasterized=True)
    axes.plot([0.0, one.length, one.length, 0.0, 0.0], [0.0, 0.0, height, height, 0.0], color=INK,
              linewidth=1.0, zorder=2)
    axes.annotate(one.wall.letter, (0.0, 0.5 * height), (-18.0, 0.0), fontsize=12, color=INK,
                  textcoords='offset points', fontweight='bold', ha='center', va='center')
    for number in one.cameras:
        placed = assessed.placement.cameras[number]
        x = float(np.array(placed.position[:2]) @ one.along) - one.start
        z = placed.position[2] - floor
        _draw_dimension(axes, np.array([[x, 0.0], [x, z]]))
        end = 0.0 if x < 0.5 * one.length else one.length
        _draw_dimension(axes, np.array([[end, z], [x, z]]))
        axes.plot(x, z, 'o', color=camera_colour(number), markersize=6, markeredgecolor='white',
                  zorder=8)
        axes.annotate(f'{number + 1} {placed.camera.name}', (x, z), (0.0, 7.0), fontsize=8,
                      textcoords='offset points', color=darkened(camera_colour(number)),
                      fontweight='bold', ha='center', va='bottom', zorder=8)
    axes.set_xticks([])
    axes.set_yticks([])


def _view_sheet(assessed: Assessment, facts: PageFacts, size: tuple[float, float],
                numbers: Sequence[int]) -> Figure:
    """Return the sheet with the depth images of up to six cameras."""
    figure, box = _empty_sheet(facts, size, 'What each camera sees')
    width, height = box.width / 3.0, box.height / 2.0
    for k, number in enumerate(numbers):
        placed = assessed.placement.cameras[number]
        left = box.left + k % 3 * width
        bottom = box.bottom + (1 - k // 3) * height
        axes = figure.add_axes(np.array([left + 0.05, bottom + 0.1, width - 0.25, height - 0.75])
                               / np.tile(size, 2))
        seen, model = assessed.seen[number], placed.camera.model
        image = depth_image(assessed.scene.points[seen], assessed.scene.pitch[seen], placed.pose,
                            model)
        axes.imshow(depth_colours(image, model), aspect='equal')
        axes.set_axis_off()
        lines = (f'{number + 1} {placed.camera.name}', f'{lens_text(model)}; '
                 f'{percent(float(seen.mean()))} of the points',
                 f'centre: {assessed.aims[number]}')
        for line, text in enumerate(lines):
            write(figure, (left + 0.05, bottom + height - 0.14 - 0.17 * line), text, width - 0.25,
                  9 if line == 0 else 7,
                  darkened(camera_colour(number)) if line == 0 else PALE_INK, bold=line == 0)
    return figure


def _material_sheet(assessed: Assessment, facts: PageFacts, size: tuple[float, float],
                    numbers: Sequence[int]) -> Figure:
    """Return the sheet with the bill, what is required, and instructions for some cameras."""
    required = [([columns, *rows], [INK if row[-1] == 'yes' else 'tab:red' for row in rows])
                for columns, rows in ((REQUIREMENT_COLUMNS, facts.requirements),
                                      (REGION_COLUMNS, facts.regions)) if rows]
    figure, box = _empty_sheet(facts, size, 'Bill of materials' + (
        ' and requirements' if required else ''))
    bill = [BILL_COLUMNS, *bill_rows(assessed.found['bill'])]
    instructions = [['', 'camera', 'sensor', 'place', 'height', 'pan', 'tilt', 'x, y, z'],
                    *(assessed.rows[number] for number in numbers)]
    tables = [(bill, [INK] * (len(bill) - 1)), *required,
              (instructions, [darkened(camera_colour(number)) for number in numbers])]
    gap, top = 0.4, box.bottom + box.height
    space = box.height - gap * len(tables)
    row_height = min(0.22, space / sum(len(rows) for rows, _ in tables))
    for rows, colours in tables:
        height = row_height * len(rows)
        draw_table(figure, (box.left, top - height, box.width, height), rows,
                   7.5 if rows is instructions else 8.0, colours)
        top -= height + gap
    return figure
