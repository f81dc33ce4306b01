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

"""
Bill of materials: cameras with their prices, mounts, and cables along walls and ceiling.

A cable runs at right angles, along the walls or in level lines under the ceiling, from the camera
to the computer; for stands also on the floor. The floor plan is a grid whose axes follow the
walls: its cells have points of the scan above or below them, and gaps between such cells are
closed.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from ocp_ros.rig.placement_file import FIXED
from ocp_ros.rig.sensors import CURRENCY, PRICES, SENSORS
from ocp_ros.rig.structure import ceiling_of
from ocp_ros.scenes.scene import Scene
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

if TYPE_CHECKING:
    from ocp_ros.report.assessment import Assessment

#: Heads of the columns of :func:`bill_rows`.
BILL_COLUMNS = ('number', 'item', 'each', 'together', 'remark')
#: Edge of the cells of the floor plan, and the height of a computer without a position, metres.
CELL_M, COMPUTER_HEIGHT_M = 0.25, 0.3
#: What is added to a cable for its way around corners, and the steps in which cables are sold.
SPARE_SHARE, CABLE_STEP_M = 0.1, 0.5
#: The mount of a camera, as an item.
MOUNT_ITEMS = {'walls': 'wall mount', 'ceiling': 'ceiling mount', 'plane': 'stand, pole or rod',
               'free': 'stand, pole or rod'}


def bill_of_materials(assessed: 'Assessment') -> dict[str, Any]:
    """
    Return what has to be bought for the cameras to be placed, as plain data.

    :returns: ``items``: ``item``, ``count``, ``price`` of one and ``sum`` (None if unknown),
        ``source`` and ``date`` of the price, and ``unverified``, figures of the sensor to compare,
        if there are any; ``cables``: ``camera``, ``along`` (walls, ceiling or floor), ``length``
        and the length to ``order``, metres; ``computer``: where they end, x, y, z, metres;
        ``total`` of the known prices, in ``currency``, and how many items ``lack`` one.
    """
    placed = [one for one in assessed.placement.cameras if one.mount != FIXED]
    items = []
    cameras = Counter((one.camera.sensor, one.camera.price) for one in placed)
    for (sensor, price), count in cameras.items():
        listed = PRICES.get(sensor)
        is_listed = listed is not None and listed.amount == price
        items.append({
            'item': SENSORS[sensor].title if sensor in SENSORS else sensor or 'camera',
            'count': count, 'price': price, 'sum': None if price is None else price * count,
            'source': listed.source if is_listed else '' if price is None else 'rig file',
            'date': listed.date if is_listed else '',
            **({'unverified': SENSORS[sensor].unverified}
               if sensor in SENSORS and SENSORS[sensor].unverified else {})})
    for mount, count in Counter(one.mount for one in placed).items():
        items.append({'item': MOUNT_ITEMS[mount], 'count': count, 'price': None, 'sum': None,
                      'source': '', 'date': ''})
    computer, cables = _cables_of(assessed)
    sums = [item['sum'] for item in items if item['sum'] is not None]
    # Mounts have no list price.
    lacking = sum(item['price'] is None for item in items[:len(cameras)])
    return {'items': items, 'cables': cables, 'computer': np.round(computer, 2).tolist(),
            'total': float(sum(sums)), 'currency': CURRENCY, 'lack': lacking}


def bill_rows(bill: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the bill as rows: number, item, price of one, price of all, remark."""
    rows = [(str(item['count']), item['item'], _amount(item['price']), _amount(item['sum']),
             '; '.join(filter(None, [
                 ', '.join(filter(None, [item['source'], item['date']])),
                 'unverified' in item and
                 f'compare with the data sheet: {item["unverified"]}'])))
            for item in bill['items']]
    lengths = Counter(cable['order'] for cable in bill['cables'])
    rows += [(str(count), f'cable of {length:g} m', '', '', 'along walls, ceiling or floor')
             for length, count in sorted(lengths.items())]
    at = ', '.join(f'{value:.2f}' for value in bill['computer'])
    rows.append(('', f'computer at {at}: all cables', '', '',
                 f'{sum(cable["length"] for cable in bill["cables"]):.1f} m without spare'))
    unknown = f'; {bill["lack"]} without a price' if bill['lack'] else ''
    return [*rows, ('', f'total in {bill["currency"]}', '', _amount(bill['total']),
                    f'cameras{unknown}')]


def _amount(price: float | None) -> str:
    """Return a price as text; a dash for an unknown one."""
    return '-' if price is None else f'{price:,.2f}'


class FloorPlan:
    """
    The floor plan of a room in cells along its walls, for the lengths of cables.

    :param scene: the room.
    :param rotation: (2, 2), map frame to the axes of the walls.
    """

    def __init__(self, scene: Scene, rotation: np.ndarray) -> None:
        self._rotation = rotation
        points = scene.points[:, :2] @ rotation.T
        # A free cell around all others, so that closing gaps does not end at the edge.
        self._low = points.min(axis=0) - 2.0 * CELL_M
        cells = np.floor((points - self._low) / CELL_M).astype(int)
        seen = np.zeros(cells.max(axis=0) + 4, dtype=bool)
        seen[tuple(cells.T)] = True
        seen = ndimage.binary_fill_holes(ndimage.binary_closing(seen, np.ones((3, 3)), 2))
        parts, _ = ndimage.label(seen)
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        self.inside = parts == sizes.argmax()
        self.edge = self.inside & ~ndimage.binary_erosion(self.inside, np.ones((3, 3)))

    def cell_of(self, position: np.ndarray, cells: np.ndarray) -> tuple[int, int]:
        """Return the cell of a position (2,), metres, map frame, or the nearest one of some."""
        found = np.argwhere(cells)
        centres = self._low + CELL_M * (found + 0.5)
        return tuple(found[np.linalg.norm(centres - self._rotation @ position, axis=1).argmin()])

    def position_of(self, cell: Sequence[int]) -> np.ndarray:
        """Return the centre of a cell: (2,) metres, map frame."""
        return self._rotation.T @ (self._low + CELL_M * (np.array(cell) + 0.5))

    def lengths_from(self, cell: tuple[int, int], cells: np.ndarray) -> np.ndarray:
        """Return the length of the way at right angles over some cells to each: (X, Y) metres."""
        numbers = np.where(cells, np.cumsum(cells).reshape(cells.shape) - 1, -1)
        pairs = [np.stack([one.ravel(), other.ravel()]) for one, other in (
            (numbers[1:], numbers[:-1]), (numbers[:, 1:], numbers[:, :-1]))]
        links = np.concatenate(pairs, axis=1)
        links = links[:, (links >= 0).all(axis=0)]
        count = int(cells.sum())
        graph = coo_matrix((np.full(links.shape[1], CELL_M), links), shape=(count, count)).tocsr()
        lengths = np.full(cells.shape, np.inf)
        lengths[cells] = dijkstra(graph, directed=False, indices=numbers[cell])
        return lengths


def _cables_of(assessed: 'Assessment') -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Return the position (3,) of the computer, metres, and the cable of each camera as data."""
    scene, rig = assessed.scene, assessed.objective.rig
    plan = FloorPlan(scene, assessed.plan_rotation[:2, :2])
    placed = [one for one in assessed.placement.cameras if one.mount != FIXED]
    ceiling, top = ceiling_of(scene), float(np.percentile(scene.points[:, 2], 99.0))
    ways: list[dict[str, np.ndarray]] = []
    for one in placed:
        x, y, z = one.position
        above = ceiling.height_above(np.array([[x, y]]))[0] if len(ceiling.points) else top
        above = max(above if np.isfinite(above) else top, z)
        floor = float(assessed.floors.under(np.array([one.position]))[0])
        start = plan.cell_of(np.array([x, y]), plan.inside)
        level = plan.lengths_from(start, plan.inside)
        # The ends of a cable are at the computer, whose height is added below.
        routes = {'ceiling': (above, level)}
        if one.mount == 'walls':
            routes['walls'] = (z, plan.lengths_from(plan.cell_of(np.array([x, y]), plan.edge),
                                                    plan.edge))
        elif one.mount != 'ceiling':
            routes['floor'] = (floor, level)
        height = floor + COMPUTER_HEIGHT_M if rig.computer is None else rig.computer[2]
        ways.append({along: abs(z - run) + lengths + abs(run - height)
                     for along, (run, lengths) in routes.items()})
    shortest = [np.minimum.reduce(list(way.values())) for way in ways]
    if rig.computer is None:
        # Beside the wall where all cables together are shortest.
        total = np.where(plan.edge, np.sum(shortest, axis=0), np.inf)
        cell = tuple(np.unravel_index(total.argmin(), total.shape))
        position = plan.position_of(cell)
        floor = float(assessed.floors.under(np.array([[*position, placed[0].position[2]]]))[0])
        computer = np.array([*position, floor + COMPUTER_HEIGHT_M])
    else:
        computer = rig.computer
        cell = plan.cell_of(computer[:2], plan.inside)
        if not all(np.isfinite(lengths[cell]) for lengths in shortest):
            cell = plan.cell_of(computer[:2], plan.edge)
    cables = []
    for one, way in zip(placed, ways):
        along = min(way, key=lambda name: way[name][cell])
        length = float(way[along][cell])
        order = CABLE_STEP_M * float(np.ceil((1.0 + SPARE_SHARE) * length / CABLE_STEP_M))
        cables.append({'camera': one.camera.name, 'along': along, 'length': round(length, 2),
                       'order': order})
    return computer, cables
