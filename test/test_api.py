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

"""The Python interface: the same answers as the commands, plug-ins, and plain messages."""

import os
import re

from conftest import printed, ROOT, run_python
import gymnasium
import numpy as np
import ocp_ros
from ocp_ros.cli.main import main
from ocp_ros.online.online_planner import Online
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.search.budget import Budget
from ocp_ros.search.planner import Planner
from ocp_ros.search.registry import PLANNERS, register_planner
from ocp_ros.simulation.simulation_config import EngineConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
import yaml

#: A package as pip leaves it: one planner that works, one that cannot be imported.
PLUGIN = """\
from ocp_ros.search.planner import Planner


class Few(Planner):
    def search(self):
        yield [self.space.random(self.rng) for _ in range(8)]
"""
ENTRIES = '[ocp_ros.planners]\nfew = few_planner:Few\nlost = few_planner:Lost\n'
#: A program that plans with it, and asks for it in a worker process.
USE_PLUGIN = """\
from ocp_ros.cli.main import main
from ocp_ros.report.drawing import report_page

report_page.draw_pages = lambda *_: ()
assert main('plan room.ply --planner few --cameras 2 --evaluations 8'.split()) == 0

from ocp_ros.compare.protocol import Protocol
from ocp_ros.search.registry import check_planner
from ocp_ros.util.worker_pool import WorkerPool

assert 'few' in Protocol().planners
with WorkerPool(1) as pool:
    assert list(pool.map(check_planner, ['few'])) == [None]
"""


def test_the_environment_is_one_of_gymnasium():
    env = gymnasium.make('ocp_ros.simulation.environment:ocp_ros/CameraPlacement-v0',
                         rooms=[7, 8], points=2000, cameras=2)
    rooms = {env.reset(seed=seed)[1]['scene'] for seed in range(8)}
    assert rooms == {'room-7', 'room-8'} and env.action_space.shape == (2, 2)


def test_plan_and_score_say_what_the_commands_say(room_folder, undrawn, capsys):
    shown = printed(capsys, 'plan', 'room.ply', '--cameras', 2, '--model', 'd455',
                    '--evaluations', 20)
    plan = ocp_ros.plan('room.ply', cameras=2, sensor='d455', evaluations=20)
    for key in ('cameras', 'scores', 'installer'):
        assert plan.found[key] == shown[key], key
    assert plan.evaluations == shown['search']['evaluations'] and plan.reached is None
    judged = printed(capsys, 'score', 'room.ply', 'out/plan/placement.yaml')
    again = ocp_ros.score('room.ply', 'out/plan/placement.yaml')
    assert again.found == judged and again.loss == plan.loss
    main(['score', 'room.ply', 'out/plan/placement.yaml'])
    shown = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert str(again).splitlines() == shown
    plan.save('mine.yaml')
    for placement in (plan, plan.placement, 'mine.yaml'):
        assert ocp_ros.score('room.ply', placement).loss == plan.loss


def test_rooms_and_rigs_come_in_many_forms(room_folder):
    scene, poses = load_scene('room.ply'), [[2.0, 2.0, 1.9], [4.0, 5.0, 1.9]]
    (room_folder / 'rig.yaml').write_text('cameras: [{sensor: kinect_v2, count: 2}]\n')
    rigs = [room_folder / 'rig.yaml', load_rig('rig.yaml'), rig_of(2, 'kinect_v2'),
            {'cameras': [{'sensor': 'kinect_v2', 'count': 2}]},
            # YAML 1.1, which PyYAML reads, has on for true.
            yaml.safe_load('{cameras: [{sensor: kinect_v2, count: 2}], mount: {on: plane}}'),
            {'cameras': ({'sensor': 'kinect_v2', 'count': np.int64(2)},),
             'mount': {'on': 'plane', 'height': np.float32(1.9)}}]
    losses = {ocp_ros.score(scene, poses, rig).loss for rig in rigs}
    losses |= {ocp_ros.score('room.ply', poses, 'rig.yaml').loss,
               ocp_ros.score(scene, poses, sensor='kinect_v2').loss}
    assert len(losses) == 1
    by_points = ocp_ros.score(scene.points, poses)
    assert by_points.placement.room['sha256']
    assert by_points.loss == pytest.approx(ocp_ros.score(scene, poses).loss, rel=0.05)
    millimetres = ocp_ros.score(1000.0 * scene.points, poses, scale=0.001)
    assert millimetres.depth_error == pytest.approx(by_points.depth_error, rel=0.01)


def test_cameras_are_counted(room):
    plan = ocp_ros.plan(room, cameras='auto', evaluations=20, target=0.5, most=3)
    assert plan.reached and len(plan.poses) == plan.found['count']['cameras'] <= 3
    assert 'Number of cameras' in str(plan)


def test_names_are_listed_before_they_are_imported():
    assert 'plan' in dir(ocp_ros)
    with pytest.raises(AttributeError, match='nothing'):
        ocp_ros.nothing  # noqa: B018


def test_the_page_lists_every_public_name():
    page = (ROOT / 'docs' / 'reference' / 'api.md').read_text()
    listed = re.findall(r'^   (\w+)$', page, re.M)
    assert sorted(listed) == sorted({*ocp_ros.__all__} - {'__version__'})
    assert all(callable(getattr(ocp_ros, name)) for name in listed)


def test_planners_of_another_package_are_known_and_a_broken_one_is_warned_of_once(room_folder):
    folder = room_folder / 'site' / 'few-1.0.dist-info'
    folder.mkdir(parents=True)
    (folder / 'METADATA').write_text('Metadata-Version: 2.1\nName: few\nVersion: 1.0\n')
    (folder / 'entry_points.txt').write_text(ENTRIES)
    (room_folder / 'site' / 'few_planner.py').write_text(PLUGIN)
    path = os.pathsep.join([str(room_folder / 'site'), str(ROOT)])
    done = run_python(USE_PLUGIN, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert 'planner: few' in (room_folder / 'out/plan/placement.yaml').read_text()
    # The worker process has the planners too, and does not warn again.
    (warned,) = [line for line in done.stderr.splitlines() if line.startswith('planner lost')]
    assert 'few_planner:Lost of few' in warned


@pytest.mark.parametrize(('name', 'planner'), [
    ('cma_es', Planner), ('truth_search', Planner), ('a,b', Planner), ('mine', 3),
    ('mine', Planner), ('mine', dict)])
def test_what_is_no_planner_is_not_registered(name, planner):
    known = dict(PLANNERS)
    with pytest.raises(ocp_ros.UserError, match='found'):
        register_planner(name, planner)
    assert known == PLANNERS


def test_an_online_planner_of_ones_own_plays(room, monkeypatch):
    class Still(Online):

        def move(self, cloud, positions, turn, turns):
            return np.zeros((len(positions), 2))

    monkeypatch.setitem(PLANNERS, 'still', None)
    del PLANNERS['still']
    register_planner('still', Still)
    plan = ocp_ros.plan(room, cameras=2, planner='still', evaluations=3)
    assert plan.planner == 'still' and plan.evaluations == 3 and '3 turns' in str(plan)
    with pytest.raises(ocp_ros.UserError, match='cameras'):
        ocp_ros.plan(room, cameras='auto', planner='still', evaluations=3)


#: Calls with a wrong argument, and how the message begins that they are refused with.
WRONG = {
    'placement: found an array of shape': lambda engine: engine.evaluate([1, 2, 3]),
    'placement: found str': lambda engine: engine.evaluate('x'),
    'placement: found NaN': lambda engine: engine.evaluate([[np.nan, 1, 1]]),
    'simulator: found': lambda _: Simulator(None, SimulationConfig()),
    'found max_points=None': lambda _: load_scene('room.ply', max_points=None),
    'path: found NoneType; expected the path of a scan': lambda _: load_scene(None),
    'path: found NoneType; expected the path of a YAML': lambda _: load_rig(None),
    'path: found int': lambda _: load_placement(3),
    'seed: found': lambda _: ocp_ros.generate_room(-1),
    'n_points: found': lambda _: ocp_ros.generate_room(1, 0),
    'sensor: found': lambda _: rig_of(2, 5), 'seconds: found': lambda _: Budget('a'),
    'evaluations: found': lambda _: Budget(evaluations=-3),
    'room: found': lambda _: ocp_ros.plan(None),
    'cameras: found': lambda engine: ocp_ros.plan(engine.scene, cameras=2.5),
    'points: found': lambda _: ocp_ros.plan(7, points='x'),
    'rig: found': lambda engine: ocp_ros.plan(engine.scene, rig=5),
    'scal: found': lambda engine: ocp_ros.plan(engine.scene, scal=1),
    'cameras[0].count: found datetime.date': lambda engine: ocp_ros.plan(
        engine.scene, yaml.safe_load('cameras: [{sensor: kinect_v2, count: 2026-01-01}]')),
    'found the key 3': lambda engine: ocp_ros.plan(engine.scene, {'mount': {3: 'plane'}}),
    'keep_clear: found nan': lambda engine: ocp_ros.plan(
        engine.scene, {'cameras': [{'sensor': 'kinect_v2'}], 'keep_clear': np.nan}),
    'progress: found': lambda engine: ocp_ros.plan(engine.scene, progress=3),
    'target: found': lambda engine: ocp_ros.plan(engine.scene, cameras='auto', target=2),
    'placement: found 1 poses': lambda engine: ocp_ros.score(
        engine.scene, [[1, 2, 1.9]], rig_of(2))}


@pytest.mark.parametrize('message', WRONG)
def test_a_wrong_argument_gets_a_sentence(room, message):
    config = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=32))
    with pytest.raises(ocp_ros.UserError, match=re.escape(message)):
        WRONG[message](Simulator(room, config))


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, np.float32('nan')])
def test_numbers_of_a_mapping_are_finite(room, value):
    region = {'name': 'a', 'box': [[0, 0, 0], [1, 1, 1]]}
    for key, rig in (
            ('keep_clear', {'keep_clear': value}), ('pitch', {'pitch': [0, value]}),
            ('weight', {'regions': [{**region, 'weight': value}]}),
            ('must_see', {'regions': [{**region, 'must_see': value}]}),
            ('overlap', {'calibratable': {'overlap': value}}),
            ('horizontal_fov', {'cameras': [{'horizontal_fov': value, 'vertical_fov': 60}]}),
            ('box', {'keep_out': [{'box': [[0, 0, 0], [1, 1, value]]}]})):
        with pytest.raises(ocp_ros.UserError, match=f'rig: .*{key}.* found'):
            ocp_ros.plan(room, {'cameras': [{'sensor': 'realsense_d455'}], **rig}, evaluations=1)
    with pytest.raises(ocp_ros.UserError, match='position'):
        ocp_ros.score(room, {'cameras': [{'sensor': 'kinect_v2', 'position': [1, value, 2]}]})
