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

"""Bills: prices of the catalogue and of rig files, and cables at right angles in a known box."""

from conftest import box_room
import numpy as np
from ocp_ros.api import score
from ocp_ros.report.bill import bill_rows, CELL_M
from ocp_ros.rig.sensors import PRICES, SENSORS
import pytest

#: The box is 6 x 4 x 2.8 m; the computer stands in the middle of the wall x = 0.
COMPUTER = [0.05, 2.0, 0.5]


def bill_in_box(positions, on, **more):
    """Return the bill of D455 at some positions in a box, which look at its middle."""
    positions = np.array(positions, dtype=float)
    to_middle = np.array([3.0, 2.0]) - positions[:, :2]
    yaws = np.arctan2(to_middle[:, 1], to_middle[:, 0])
    poses = np.column_stack([positions, yaws, np.full((len(yaws), 2), [0.3, 0.0])])
    rig = {'cameras': [{'sensor': 'realsense_d455', 'count': len(poses)}],
           'mount': {'on': on}, **more}
    return score(box_room(), poses, rig).found['bill']


@pytest.mark.parametrize(('on', 'position', 'along', 'metres'), [
    # Three metres to the corner, two to the computer, and down.
    ('walls', [3.0, 0.1, 2.0], 'walls', 3.0 + 2.0 + 1.5),
    # Opposite: up, straight across under the ceiling, and down; around by the walls is farther.
    ('walls', [5.9, 2.0, 2.5], 'ceiling', 0.3 + 6.0 + 2.3),
    ('ceiling', [4.0, 3.0, 2.7], 'ceiling', 0.1 + 4.0 + 1.0 + 2.3),
    ('plane', [4.0, 1.0, 1.0], 'floor', 1.0 + 4.0 + 1.0 + 0.5)])
def test_cables_run_at_right_angles_on_the_shortest_way(on, position, along, metres):
    bill = bill_in_box([position], on, computer=COMPUTER)
    cable, = bill['cables']
    assert cable['along'] == along and bill['computer'] == [0.05, 2.0, 0.5]
    assert cable['length'] == pytest.approx(metres, abs=3 * CELL_M)
    assert 1.1 * cable['length'] <= cable['order'] < 1.1 * cable['length'] + 0.5


def test_a_computer_without_a_position_stands_where_cables_are_short():
    positions = [[3.0, 0.1, 2.0], [4.0, 0.1, 2.0]]
    found = bill_in_box(positions, 'walls')
    total = sum(cable['length'] for cable in found['cables'])
    assert 3.0 - CELL_M <= found['computer'][0] <= 4.0 + CELL_M and found['computer'][1] < 0.3
    assert total < sum(cable['length'] for cable in bill_in_box(
        positions, 'walls', computer=COMPUTER)['cables'])


def test_prices_are_those_of_the_catalogue_unless_the_file_has_others():
    assert set(PRICES) <= set(SENSORS) and all(
        price.amount > 0 and price.source and price.date for price in PRICES.values())
    bill = bill_in_box([[3.0, 0.1, 2.0], [4.0, 0.1, 2.0]], 'walls')
    d455 = PRICES['realsense_d455']
    assert bill['items'][0] == {
        'item': SENSORS['realsense_d455'].title, 'count': 2, 'price': d455.amount,
        'sum': 2 * d455.amount, 'source': d455.source, 'date': d455.date}
    assert bill['total'] == 2 * d455.amount and bill['lack'] == 0
    assert bill_rows(bill)[-1][3] == f'{2 * d455.amount:,.2f}'
    own = bill_in_box([[3.0, 0.1, 2.0]], 'walls', cameras=[{
        'sensor': 'realsense_d455', 'price': 100}])
    assert own['total'] == 100.0 and own['items'][0]['source'] == 'rig file'
    unknown = bill_in_box([[3.0, 0.1, 2.0]], 'walls', cameras=[{'sensor': 'gemini_2'}])
    assert 'data sheet' not in bill_rows(unknown)[0][4]
    # Figures that no public page confirmed are named where the sensor is bought.
    doubted = bill_rows(bill_in_box([[3.0, 0.1, 2.0]], 'walls', cameras=[
        {'sensor': 'gemini_335'}]))
    assert doubted[0][4] == 'compare with the data sheet: ' + SENSORS['gemini_335'].unverified
    assert unknown['lack'] == 1 and '1 without a price' in bill_rows(unknown)[-1][4]
