# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of ``policy_node``."""

from dataclasses import dataclass

from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.ros.runtime.managed_node import autostart
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError, setting

LEARNED, LOOKAHEAD, BOTH = PLANNERS = 'learned', 'lookahead', 'learned_lookahead'
#: Defaults where a person moves the cameras, to whom each turn is work: few turns, long moves.
BY_HAND = {'turns': 5, 'max_step': 2.0, 'max_turn': 1.6}


@dataclass(frozen=True)
class PolicyNodeConfig:
    """Parameters of ``policy_node``."""

    planner: str = setting(
        BOTH, 'who chooses the moves: learned, a trained policy; lookahead, planning on what '
        'has been seen, which needs no weights and takes none that arrive; learned_lookahead, the '
        'policy first, then lookahead, which refines', choices=PLANNERS)
    model: str = setting(
        DEFAULT_MODEL, 'path to weights, or the name of a model of the package; lookahead does '
        'not read it')
    turns: int = setting(
        30, 'turns until the placement is final; 5 with manual', 1, 100000, running=True)
    max_step: float = setting(
        0.5, 'farthest a camera moves in one turn, metres; 2 with manual', 0.001, 10.0,
        running=True)
    max_turn: float = setting(
        0.5, 'how far a camera of a rig file that does not see all around is turned in one '
        'turn, radians; 1.6 with manual; 0 leaves cameras turned as they are', 0.0, 3.1416,
        running=True)
    max_range: float = setting(
        4.0, 'effective range of the cameras, metres', 0.1, 100.0, running=True)
    wall_margin: float = setting(
        0.1, 'cameras stay this far inside the observed bounding box, metres', 0.0, 5.0,
        running=True)
    clearance: float = setting(
        CLEARANCE, 'cameras without a rig file stay this far from every surface that was seen, '
        'metres; 0 for cameras that may stand anywhere; with a rig file its keep_clear holds', 0.0,
        5.0, running=True)
    convergence_distance: float = setting(
        0.02, 'moves shorter than this count as standing still, metres', 0.0, 1.0, running=True)
    convergence_turns: int = setting(
        3, 'turns of standing still that make the placement final, with planner: learned; '
        'lookahead refines until the turns are used up', 1, 1000, running=True)
    explore: bool = setting(
        False, "draw moves from the policy's distribution, whoever is the planner, and never "
        'settle: for training')
    seed: int = setting(0, 'seed of exploration and lookahead', 0, 1 << 31)
    threads: int = setting(
        0, 'threads that try places at once; 0 for one on each core', 0, 1024)
    rig_file: str = setting(
        '', 'YAML of docs/rig.md that every command is held to; empty for none')
    placement_file: str = setting(
        '', 'the final placement is written here as well, .yaml or .json of docs/placement.md; '
        'empty for nowhere')
    scan: str = setting(
        '', 'live: a scan of the room in the frame of the poses, metres, z up: `~/calibrate` '
        'registers the cameras to it; empty for none')
    drift_seconds: float = setting(
        0.0, 'live: how often cameras whose placement is final are compared with the scan, '
        'seconds; 0 for never', 0.0, 86400.0, running=True)
    cloud_topics: str = setting(
        '', 'live cameras: the topics of their clouds with commas between; empty to answer the '
        'turns of a simulation')
    voxel_size: float = setting(
        0.05, 'live: edge of the voxels that clouds are fused on, metres', 0.001, 1.0)
    most_points: int = setting(
        100000, 'live: most points of the fused cloud; where there are more, the voxels grow',
        1000, 10000000)
    min_range: float = setting(
        0.0, 'live: points nearer to their camera are left out, metres', 0.0, 10.0, running=True)
    arrival_distance: float = setting(
        0.05, 'live: a camera this near to where it was sent is there, metres', 0.01, 1.0,
        running=True)
    arrival_angle: float = setting(
        0.1, 'live: a camera turned to within this of how it shall be is there, radians', 0.01,
        3.1416, running=True)
    arrival_timeout: float = setting(
        20.0, 'live: cameras that have not arrived after so long are where they are, seconds',
        0.1, 3600.0, running=True)
    cloud_timeout: float = setting(
        2.0, 'live: clouds are waited for so long once the cameras stand, seconds', 0.1, 3600.0,
        running=True)
    turn_seconds: float = setting(
        0.0, 'live: a turn lasts at least so long, seconds; max_step within it is the fastest '
        'that cameras are sent', 0.0, 3600.0, running=True)
    autostart: bool = autostart()
    manual: bool = setting(
        False, 'live: a person moves the cameras, reads where to on `instructions`, and takes as '
        'long as it takes; a turn is work then, so there are few, with long moves')

    def __post_init__(self) -> None:
        """Refuse what contradicts itself."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(
                f'min_range: found {self.min_range} m with max_range {self.max_range} m; '
                'expected less than it')
        if self.scan and not self.clouds:
            raise ConfigurationError('scan: found one without cloud_topics; expected live cameras '
                                     'to register to it; name the topics of their clouds')
        if self.manual and not self.clouds:
            raise ConfigurationError('manual: found true without cloud_topics; expected live '
                                     'cameras that a person moves; name the topics of their '
                                     'clouds')

    @property
    def clouds(self) -> list[str]:
        """Return the topics of live clouds; none where a simulation is answered."""
        names = [name.strip() for name in self.cloud_topics.split(',')]
        return [name for name in names if name]

    @property
    def weightless(self) -> bool:
        """Return whether no policy is asked."""
        return self.planner == LOOKAHEAD and not self.explore
