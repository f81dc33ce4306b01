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
Draw what the package is made of: layers, and nodes with their topics.

``python -m benchmarks.docs.architecture_picture --out docs/architecture.png``
"""

import argparse
from pathlib import Path
import sys

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.saved_pictures import save_figure

#: Layers from the bottom, and what each is for; each may import those below it.
LAYERS = {
    'util': 'settings, files, threads, worker processes',
    'geometry': 'what a camera sees of points: arrays in, arrays out',
    'scenes': 'rooms from files',
    'rooms': 'generated rooms',
    'rig': 'cameras, mounts, constraints, their files',
    'simulation': 'a rig in a room: engine, objective, episode',
    'registration': 'live clouds to scans: where cameras are mounted',
    'online': 'partial map, planners without a scan',
    'policy': 'networks, weights, who runs them',
    'search': 'planners that know the scan, and the proof',
    'report': 'a planned rig, its findings and pages',
    'formats': 'files for other programs',
    'studio': 'a page on which cameras are moved',
    'training': 'soft actor-critic',
    'compare': 'one protocol for all planners',
    'ros': 'ROS 2 nodes: convert, call, publish',
    'demo': 'node processes, and who watches them',
    'cli': 'ocp: one file a command'}
#: Where nodes stand, in a picture of 10 x 6.
NODES = {'sim_node\nor your cameras': (6.0, 4.6), 'policy_node': (9.1, 4.6),
         'trainer_node': (9.1, 1.9), 'RViz, plots': (6.0, 1.9)}
#: Where arrows begin and end, their topics, and where these are written.
TOPICS = (
    ((6.75, 4.75), (8.35, 4.75), ('observation', 'camera_poses', 'reward'), (7.55, 5.15)),
    ((8.35, 4.45), (6.75, 4.45), ('camera_commands',), (7.55, 4.25)),
    ((8.85, 4.2), (8.85, 2.3), ('experience', 'camera_poses', 'reward'), (8.35, 3.05)),
    ((9.45, 2.3), (9.45, 4.2), ('policy_weights', 'training'), (9.45, 3.25)),
    ((6.0, 4.2), (6.0, 2.3), (
        'scene', 'markers', 'space_coverage', 'depth_error', 'true_coverage_cloud',
        'true_error_cloud'), (5.95, 3.35)),
    ((8.35, 4.2), (6.75, 2.3), (
        'placement', 'placement_status', 'instructions', 'rig_markers',
        'coverage_cloud', 'error_cloud'), (7.25, 2.85)))
FILLS = ('#e8f1f8', '#d7e6f2')


def draw(path: Path) -> None:
    """Write the picture as PNG, 1500 x 900 pixels."""
    figure = Figure(figsize=(10.0, 6.0), dpi=150, facecolor='white')
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, 10.0), ylim=(0.0, 6.0))
    axes.set_axis_off()
    _title(axes, 0.3, 'Layers: each imports those below it')
    for number, (name, about) in enumerate(LAYERS.items()):
        bottom = 0.2 + 0.275 * number
        _box(axes, 0.3, bottom, 4.3, 0.24, FILLS[number % 2])
        axes.text(0.45, bottom + 0.12, name, fontsize=9.0, fontweight='bold', color=INK,
                  va='center', zorder=3)
        axes.text(1.55, bottom + 0.12, about, fontsize=7.5, color=PALE_INK, va='center',
                  zorder=3)
    _title(axes, 5.2, 'Nodes and topics')
    for name, (x, y) in NODES.items():
        _box(axes, x - 0.7, y - 0.35, 1.4, 0.7, '#fdf0d9')
        axes.text(x, y, name, fontsize=8.5, fontweight='bold', color=INK, ha='center',
                  va='center', zorder=3)
    for start, end, topics, place in TOPICS:
        axes.add_patch(FancyArrowPatch(start, end, shrinkA=0, shrinkB=0, arrowstyle='-|>',
                                       color=PALE_INK, mutation_scale=11, linewidth=1.1))
        axes.text(*place, '\n'.join(topics), fontsize=7, family='monospace', color=INK,
                  ha='center', va='center', bbox={'facecolor': 'white', 'edgecolor': 'none',
                                                  'pad': 1.5})
    axes.text(5.2, 0.95, 'Without ROS: ocp on a shell uses the same layers, from scenes\n'
              'to formats, and CameraPlacementEnv is a Gymnasium environment.', fontsize=8,
              color=PALE_INK, va='center', zorder=3)
    save_figure(figure, path)


def _title(axes: Axes, left: float, text: str) -> None:
    """Write a headline."""
    axes.text(left, 5.62, text, fontsize=12, fontweight='bold', color=INK, va='center', zorder=3)


def _box(axes: Axes, left: float, bottom: float, width: float, height: float, colour: str
         ) -> None:
    """Draw a box."""
    axes.add_patch(FancyBboxPatch((left, bottom), width, height, facecolor=colour, linewidth=0,
                                  boxstyle='round,pad=0,rounding_size=0.08', zorder=2))


def main(argv: list[str] | None = None) -> int:
    """Draw the picture of the documentation."""
    parser = argparse.ArgumentParser(prog='architecture', description='Draw the architecture.')
    parser.add_argument('--out', type=Path, default=Path('docs/architecture.png'))
    arguments = parser.parse_args(argv)
    draw(arguments.out)
    print(f'wrote {arguments.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
