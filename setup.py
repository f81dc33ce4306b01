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

"""Package for ROS 2 (ament_python) and for pip."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'ocp_ros'


def share(folder, pattern='*'):
    """Install the files of one folder under the package's share."""
    return (f'share/{NAME}/{folder}', sorted(glob(f'{folder}/{pattern}')))


setup(
    name=NAME,
    version='0.1.0',
    description='Online optimal placement of depth cameras in indoor rooms',
    license='Apache-2.0',
    author='The ocp_ros authors',
    maintainer='The ocp_ros authors',
    maintainer_email='maintainers@example.org',
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        share('launch', '*.launch.py'),
        share('config', '*.*'),
        share('config/rig', '*.yaml'),
        share('config/train', '*.yaml'),
        share('models', '*.*'),
    ],
    package_data={NAME: ['report/*.json', 'report/templates/*']},
    zip_safe=True,
    # What the nodes need: all of it are packages of Ubuntu, whose rosdep keys package.xml names.
    install_requires=[
        'setuptools', 'numpy>=1.26', 'numba', 'scipy', 'torch', 'pyyaml', 'jsonschema',
        'matplotlib', 'rich', 'pillow'],
    # What the programs beside them need; ocp_ros.util.settings names the extra if it is missing.
    extras_require={
        'plan': ['cma', 'highspy', 'plotly'],
        'files': ['laspy[lazrs]', 'open3d', 'plyfile', 'pye57', 'rosbags'],
        'train': ['gymnasium', 'stable-baselines3', 'tensorboard'],
        'studio': ['viser==1.1.1'],
        'buildings': ['ezdxf==1.4.5', 'ifcopenshell==0.9.0.post1', 'usd-core==26.11'],
        'ray': ['ray'],
        'test': ['pytest', 'pytest-timeout', 'hypothesis', 'safetensors']},
    entry_points={
        'console_scripts': [
            'sim_node = ocp_ros.ros.start:sim_node',
            'policy_node = ocp_ros.ros.start:policy_node',
            'trainer_node = ocp_ros.ros.start:trainer_node',
            'guide_node = ocp_ros.ros.start:guide_node',
            'demo = ocp_ros.demo.demo:main',
            'train_demo = ocp_ros.demo.train_demo:main',
            'ocp = ocp_ros.cli.start:main',
        ],
    },
)
