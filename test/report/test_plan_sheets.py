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

"""The sheets for the installer are to scale, and say what hangs where."""

import re

from conftest import box_room
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.drawing.plan_sheets import PAPERS, sheets_of, write_sheets
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
import pytest


@pytest.fixture(scope='module')
def assessed():
    """Return three cameras in a room of 6 x 4 m: on wall D, on wall A and on a stand."""
    poses = np.array([[0.1, 1.5, 2.2, 0.2, 0.4, 0.0], [4.0, 3.9, 2.4, -1.5, 0.5, 0.0],
                      [3.0, 2.0, 1.5, 0.0, 0.2, 0.0]])
    rig = rig_of(3, 'd455', mount={'on': 'free', 'height': [1, 2.5]}, require={
        'pixel_density': 'overview', 'share': 0.9})
    engine = EngineConfig(preset='fast', error_rows=32)
    return assess(box_room(), placement_of(rig, poses, engine=engine), {'sha256': ''}, 'ocp score')


def texts_of(figure):
    """Return all texts of a sheet."""
    return [text.get_text() for axes in figure.axes for text in axes.texts] + [
        text.get_text() for text in figure.texts]


@pytest.mark.parametrize(('paper', 'scale'), [('A4', 50), ('A3', 20)])
def test_plan_and_elevations_are_to_scale(assessed, paper, scale):
    plan, walls, views, materials = sheets_of(assessed, PAPERS[paper])
    for figure in (plan, walls):
        title = figure.texts[0].get_text()
        scale_of_sheet = int(title.split('1 : ')[1])
        assert figure is walls or scale_of_sheet == scale
        for axes in figure.axes:
            # Inches of a metre on the sheet, across and up.
            inches = np.diff(axes.transData.transform([(0.0, 0.0), (1.0, 1.0)]), axis=0)
            assert inches[0] / figure.dpi == pytest.approx(1000.0 / 25.4 / scale_of_sheet)
            # Everything drawn is on the sheet.
            low, high = axes.get_xlim()
            assert all(low <= line.get_xdata().min() and line.get_xdata().max() <= high
                       for line in axes.lines)
    assert {'6.00 m', '4.00 m', '200 cm'} <= set(texts_of(plan))
    # Wall A seen from inside: the camera is 2 m from its right end. On wall D it is 1.5 m from
    # the left end.
    assert {'2.40 m', '2.20 m', '2.00 m', '1.50 m'} <= set(texts_of(walls))
    assert sum(bool(axes.images) for axes in views.axes) == 3
    found = texts_of(materials)
    assert {'Intel RealSense D455', 'the whole room', '90.0 %', 'no'} <= set(found)
    assert any('density' in text or 'px/m' in text for text in found)


def test_the_pages_of_the_file_have_the_size_of_the_paper(assessed, tmp_path):
    write_sheets(tmp_path / 'a3.pdf', assessed, 'A3')
    boxes = re.findall(rb'/MediaBox \[([^]]*)\]', (tmp_path / 'a3.pdf').read_bytes())
    # In points of 1/72 inch: 420 x 297 mm.
    for box in boxes:
        size = np.array(box.split(), dtype=float)[2:] / 72.0 * 25.4
        assert size == pytest.approx([420.0, 297.0], abs=0.5)
    assert len(boxes) == 4
