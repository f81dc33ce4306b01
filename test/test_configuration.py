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

"""Configuration: defaults, round trips, and errors that say what to do."""

from conftest import ROOT
import numpy as np
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training.run_folder import read_config
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import ConfigurationError, from_flat, from_nested, leaves, to_nested
import pytest
import yaml


@pytest.mark.parametrize('cls', [SimulationConfig, TrainingConfig])
def test_nested_form_comes_back_and_what_is_left_out_keeps_its_default(cls):
    assert from_nested(cls, to_nested(cls())) == cls() == from_nested(cls, {})
    # Whole numbers are accepted as floats.
    assert from_flat(SimulationConfig, {'rig.max_range': 5}).rig.max_range == 5.0


@pytest.mark.parametrize(('cls', 'values', 'words'), [
    (SimulationConfig, {'rig': {'camera': 2}}, "'rig.camera'.*'rig.cameras'"),
    (SimulationConfig, {'zzz': 2}, "'zzz'"),
    (SimulationConfig, {'rig': {'cameras': 0}}, 'rig.cameras: found 0.* 1 to 64'),
    (SimulationConfig, {'rig': {'cameras': '4'}}, "rig.cameras: found '4'.*int"),
    (SimulationConfig, {'rig': {'cameras': True}}, 'rig.cameras: found True'),
    (SimulationConfig, {'rig': {'height': float('nan')}}, 'rig.height: found nan'),
    (SimulationConfig, {'rig': {'min_range': 5.0}}, 'rig.min_range.*rig.max_range'),
    (SimulationConfig, {'rig': {'sensors': 'realsense_d436'}}, "rig.sensors.*'realsense_d435'"),
    (SimulationConfig, {'rig': {'sensors': 'kinect_v2,kinect_v2'}}, '2 sensors.*rig.cameras 4'),
    (SimulationConfig, {'rig': {'sensors': ''}}, 'rig.sensors'),
    (SimulationConfig, {'reward': {'kind': 'papr'}}, "reward.kind: found 'papr'"),
    (TrainingConfig, {'fewest_cameras': 5}, 'fewest_cameras.*simulation.rig.cameras'),
    (TrainingConfig, {'agent': {'inputs': 'cloud'}}, 'interactions'),
    (TrainingConfig, {'agent': {'inputs': 'paper'}, 'fewest_cameras': 2}, 'agent.cameras')])
def test_a_bad_setting_is_named_with_what_was_expected(cls, values, words):
    with pytest.raises(ConfigurationError, match=words):
        from_nested(cls, values)


@pytest.mark.parametrize(('text', 'words'), [
    ('- 1\n- 2\n', 'c.yaml: found list'), ('a: [1, 2\nb: }', 'c.yaml: line 2')])
def test_a_file_without_a_mapping_is_refused_in_one_line(tmp_path, text, words):
    (tmp_path / 'c.yaml').write_text(text)
    with pytest.raises(ConfigurationError, match=words) as caught:
        read_config(tmp_path / 'c.yaml')
    assert '\n' not in str(caught.value)


def test_every_setting_has_a_default_in_its_own_range():
    for name, item in leaves(TrainingConfig).items():
        assert isinstance(item.default, item.type), name
        low = item.metadata['low']
        assert low is None or low <= item.default <= item.metadata['high'], name
        assert len(item.metadata['description']) > 5


@pytest.mark.parametrize('path', sorted((ROOT / 'config' / 'train').glob('*.yaml')),
                         ids=lambda path: path.name)
def test_every_shipped_training_configuration_is_valid(path):
    assert np.isfinite(read_config(path).sac.learning_rate)


@pytest.mark.parametrize('name', ['sim', 'policy', 'trainer', 'live'])
def test_every_shipped_parameter_file_is_valid(name):
    pytest.importorskip('rclpy', reason='node parameters need ROS 2 (rclpy)')
    from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
    from ocp_ros.ros.sim_node import SimNodeConfig
    from ocp_ros.ros.trainer_node import TrainerNodeConfig
    # That of live cameras is read by a policy of any name.
    classes = {'sim_node': SimNodeConfig, 'policy_node': PolicyNodeConfig,
               'trainer_node': TrainerNodeConfig, '/**': PolicyNodeConfig}
    content = yaml.safe_load((ROOT / 'config' / f'{name}.yaml').read_text())
    for key, value in content.items():
        cls = classes[key.removeprefix('/**/')]
        from_nested(cls, value['ros__parameters'], key)
