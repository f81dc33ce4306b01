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

"""When a turn of real cameras is due, told by a clock that the tests turn by hand."""

import math
from types import SimpleNamespace

from conftest import for_any
from hypothesis import strategies
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.ros.policy.turns import JUMP_REPORT_S, QUIET_S, STEADY_NS, Turns, WaitLimits
import pytest

S = 1_000_000_000
HERE = np.array([[1.0, 1.0, 1.9], [3.0, 1.0, 1.9]])
THERE = HERE + [[0.4, 0.0, 0.0], [0.0, -0.3, 0.0]]


@pytest.fixture
def clock():
    """Return a clock that tells the time that a test sets."""
    return SimpleNamespace(now=0.0)


def make(clock, topics='ab', arrival_timeout=20.0):
    """Return turns of cameras that may be 5 cm off, and clouds that may take 2 s."""
    return Turns(list(topics), WaitLimits(0.05, arrival_timeout, 2.0), lambda: clock.now)


def stands(turns, stamp, positions):
    """Say of cameras for long enough that they stand somewhere, from some stamp in seconds on."""
    turns.on_poses(int(stamp * S), positions)
    turns.on_poses(int(stamp * S) + STEADY_NS, positions)


def taken(turns):
    """Take all clouds that can be taken."""
    return list(iter(turns.take_cloud, None))


def delivered(turns, stamp, cloud, topics='ab'):
    """Deliver a cloud of each topic, with a stamp in seconds; take all that can be taken."""
    for topic in topics:
        turns.on_cloud(topic, int(stamp * S), cloud)
    return taken(turns)


def until_due(clock, turns, measured, first_stamp=100.0, topics='a'):
    """Send what is measured, and clouds, 20 times a second; return when a turn is due: seconds."""
    began = clock.now
    while not turns.is_due() and clock.now < began + 60.0:
        clock.now += 0.05
        stamp = first_stamp + clock.now
        turns.on_poses(int(stamp * S), measured(), [np.eye(3)] * 2)
        delivered(turns, stamp, 'cloud', topics)
    return clock.now - began


@pytest.fixture
def turns(clock):
    """Return turns after the first one, at 10 s: it sent the cameras from HERE to THERE."""
    turns = make(clock)
    # Clouds may come before the first poses.
    turns.on_cloud('a', 9 * S, 'too old')
    assert not turns.is_due()
    stands(turns, 10, HERE)
    assert taken(turns) == []
    assert delivered(turns, 10, 'first') == [('a', 'first'), ('b', 'first')] and turns.is_due()
    turns.on_command(THERE)
    return turns


def test_cameras_on_their_last_centimetres_do_not_stand_yet(turns):
    # 0.3 m/s, seen 20 times a second, from 4.5 cm before the target to 4.5 cm behind it.
    for tick in range(7):
        turns.on_poses(11 * S + tick * S // 20, THERE + [0.045 - 0.015 * tick, 0.0, 0.0])
        turns.on_cloud('a', 11 * S + tick * S // 20, tick)
        assert taken(turns) == []
    # They stand from the first of those that are alike on.
    rest = THERE + [0.01, 0.0, 0.0]
    for tick in range(20, 24):
        turns.on_poses(11 * S + tick * S // 20, rest)
        turns.on_cloud('a', 11 * S + tick * S // 20, tick)
    assert not turns.cameras_stand
    turns.on_poses(12 * S + STEADY_NS, rest)
    assert turns.cameras_stand and turns.standing_begin.stamp == 12 * S
    assert taken(turns) == [('a', 23)]


def test_a_turn_waits_until_cameras_are_turned(clock):
    turns = make(clock, topics='a')
    turns.limits = turns.limits._replace(arrival_angle=0.1)
    turns.on_poses(1, HERE, [rotation_matrix(0.0), rotation_matrix(1.0)])
    turns.on_command(HERE, {1: rotation_matrix(1.5)})
    assert not turns.cameras_stand
    turns.on_poses(2, HERE, [rotation_matrix(2.0), rotation_matrix(1.3)])
    assert not turns.cameras_stand
    for stamp in (3, 3 + STEADY_NS):
        turns.on_poses(stamp, HERE, [rotation_matrix(2.0), rotation_matrix(1.45)])
    assert turns.cameras_stand and turns.standing_begin.stamp == 3


def test_a_rig_that_says_once_where_it_is_stands_there(clock, turns):
    turns.on_poses(11 * S, THERE)
    assert delivered(turns, 11, 1, 'a') == []
    clock.now = QUIET_S
    assert taken(turns) == [('a', 1)] and turns.standing_begin.stamp == 11 * S


def test_who_did_not_send_the_cameras_waits_until_they_stand(clock):
    turns = make(clock, topics='a')
    stands(turns, 10, HERE)
    assert delivered(turns, 10, 'here', 'a') == [('a', 'here')] and turns.is_due()
    # Somebody else sends them elsewhere.
    turns.on_poses(11 * S, THERE)
    assert delivered(turns, 11, 'on the way', 'a') == [] and not turns.is_due()
    turns.on_poses(11 * S + STEADY_NS, THERE)
    assert taken(turns) == [('a', 'on the way')] and turns.is_due()
    assert max(turns.used_stamps.values()) == 11 * S


def test_a_topic_with_two_clocks_does_not_stop_the_others(clock):
    turns = make(clock, topics='abc')
    stands(turns, 100, HERE)
    played = 0
    for tick in range(200):
        clock.now += 0.1
        stamp = 101 * S + tick * S // 10
        turns.on_poses(stamp, HERE)
        # Every other cloud of a is 5 s old, b is as it should be, c is silent.
        turns.on_cloud('a', stamp - 5 * S * (tick % 2), tick)
        turns.on_cloud('b', stamp, tick)
        taken(turns)
        if turns.is_due():
            played += 1
            turns.on_command(HERE)
    assert played >= 5 and turns.jumped_source()
    clock.now += JUMP_REPORT_S + 0.1
    assert not turns.jumped_source()


def test_a_turn_lasts_as_long_as_it_has_to(clock, turns):
    turns.limits = turns.limits._replace(min_duration=5.0)
    stands(turns, 12, THERE)
    assert len(delivered(turns, 12, 'cloud')) == 2
    clock.now = 4.9
    assert not turns.is_due()
    clock.now = 5.0
    assert turns.is_due()


def test_a_turn_waits_until_every_camera_is_there(turns):
    for stamp, positions in ((11, HERE), (12, THERE + [[0.0] * 3, [0.06, 0.0, 0.0]])):
        stands(turns, stamp, positions)
        assert delivered(turns, stamp, stamp) == [] and not turns.is_due()
    # How high they are makes no difference to those that were not sent up or down.
    stands(turns, 13, THERE + [0.04, 0.0, 0.5])
    assert taken(turns) == [] and not turns.is_due()
    assert delivered(turns, 13, 13) == [('a', 13), ('b', 13)] and turns.is_due()
    np.testing.assert_allclose(turns.positions, THERE + [0.04, 0.0, 0.5])
    raised = THERE + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]
    turns.on_command(raised)
    stands(turns, 14, THERE)
    assert not turns.cameras_stand
    stands(turns, 15, raised - [0.0, 0.0, 0.03])
    assert turns.cameras_stand


def test_cameras_that_leave_again_are_waited_for_again(turns):
    stands(turns, 11, THERE)
    assert delivered(turns, 11, 1, 'a') == [('a', 1)]
    # A topic gives one cloud a turn.
    assert delivered(turns, 11.5, 2, 'a') == []
    stands(turns, 12, HERE)
    assert delivered(turns, 12, 2, 'b') == [] and not turns.is_due()
    stands(turns, 13, THERE)
    assert delivered(turns, 13, 3) == [('a', 3), ('b', 3)] and turns.is_due()


def test_a_silent_topic_is_not_waited_for_without_end(clock, turns):
    stands(turns, 11, THERE)
    delivered(turns, 11, 1, 'a')
    clock.now = 1.9
    assert not turns.is_due() and not turns.silent_topics()
    clock.now = 2.0
    assert turns.is_due()
    assert turns.silent_topics() == {'b': 'stamps 1.0 s before the poses'}
    # It stays among the silent ones until it delivers something that can be used.
    turns.on_command(HERE)
    stands(turns, 12, HERE)
    assert not turns.is_due() and turns.silent_topics() == {'b': 'stamps 2.0 s before the poses'}
    delivered(turns, 12, 2, 'b')
    assert not turns.silent_topics()


def test_a_cloud_that_is_refused_is_as_good_as_none(clock):
    turns = make(clock)
    stands(turns, 10, HERE)
    delivered(turns, 10, 'cloud')
    turns.refuse_cloud('a')
    assert not turns.is_due()
    clock.now = 2.0
    assert turns.is_due() and turns.silent_topics() == {'a': 'nothing usable'}
    turns.refuse_cloud('b')
    assert not turns.is_due()


def test_a_turn_goes_on_though_the_cameras_do_not_arrive(clock, turns):
    half = 0.5 * (HERE + THERE)
    turns.on_poses(11 * S, half)
    clock.now = 19.9
    assert delivered(turns, 11, 1, 'a') == [] and not turns.is_due()
    clock.now = 20.0
    assert taken(turns) == [('a', 1)] and turns.overdue and turns.overdue_turns == 1
    # It stays so, whatever they do now.
    stands(turns, 12, half + 0.1)
    assert delivered(turns, 12, 2, 'b') == [('b', 2)] and turns.is_due()
    np.testing.assert_allclose(turns.positions, half + 0.1)
    turns.on_command(THERE)
    assert not turns.overdue and turns.overdue_turns == 1


def test_without_poses_nobody_knows_where_the_cameras_are(clock, turns):
    clock.now = 1000.0
    assert delivered(turns, 900, 1, 'a') == [] and not turns.is_due() and turns.positions is None


def test_cameras_that_need_not_move_are_there_whether_or_not_they_say_so(turns):
    stands(turns, 11, THERE)
    delivered(turns, 12, 'cloud')
    turns.on_cloud('a', 12 * S, 'waits')
    turns.on_command(THERE + [0.03, 0.0, 0.0])
    # Only newer clouds count.
    turns.on_cloud('a', 12 * S - 1, 'old')
    assert taken(turns) == [] and turns.positions is THERE
    assert delivered(turns, 12.001, 'new') == [('a', 'new'), ('b', 'new')] and turns.is_due()


def test_a_person_may_take_as_long_as_they_like(clock, turns):
    turns.limits = turns.limits._replace(arrival_timeout=math.inf)
    clock.now = 1e6
    stands(turns, 11, HERE)
    assert delivered(turns, 12, 1, 'a') == [] and not turns.is_due()


def test_a_camera_that_still_turns_does_not_stand_yet(clock):
    turns = make(clock, topics='a')
    for tick in range(8):
        turned = [rotation_matrix(0.04 * tick, 0.0, 0.0)] * 2
        turns.on_poses(10 * S + tick * S // 20, HERE, turned)
    assert not turns.cameras_stand
    turns.on_poses(11 * S, HERE, turned)
    turns.on_poses(11 * S + STEADY_NS, HERE, turned)
    assert turns.cameras_stand


@pytest.mark.parametrize('sources', [['poses', 'a', 'b', 'a'], ['a', 'poses', 'b', 'a']])
def test_stamps_that_go_back_are_noticed_and_stop_nothing(turns, sources):
    stands(turns, 100, THERE)
    turns.on_cloud('a', 101 * S, 'from before')
    for number, source in enumerate(sources):
        if source == 'poses':
            stands(turns, 5, THERE)
        else:
            turns.on_cloud(source, 5 * S + number, 'anew')
    assert taken(turns) == [('a', 'anew'), ('b', 'anew')] and turns.is_due()
    assert turns.stamp_jumps == 1 and max(turns.used_stamps.values()) == 5 * S + 3


def test_stamps_that_go_back_while_the_cameras_are_on_their_way(clock, turns):
    stands(turns, 100, HERE)
    clock.now = 20.0
    assert delivered(turns, 5, 'anew', 'a') == [('a', 'anew')]
    assert turns.overdue and turns.stamp_jumps == 1


def test_a_little_disorder_is_no_jump(turns):
    stands(turns, 11, THERE)
    assert not turns.on_poses(11 * S - S // 2, HERE)
    np.testing.assert_allclose(turns.positions, THERE)
    turns.on_cloud('a', 11 * S, 1)
    turns.on_cloud('a', 11 * S - S // 2, 2)
    assert taken(turns) == [('a', 1)] and turns.stamp_jumps == 0


def test_noisy_poses_stop_no_turn_and_their_mean_counts(clock):
    rng, turns, sigma = np.random.default_rng(1), make(clock, topics='a'), 0.03
    for goal, following in [(HERE, THERE), (THERE, HERE)] * 2:
        assert until_due(clock, turns,
                         lambda at=goal: at + rng.normal(0.0, sigma, HERE.shape)) < 5.0
        measured, rotations = turns.mean_poses
        assert not turns.overdue and np.abs(measured - goal).max() < 0.7 * sigma
        assert len(rotations) == 2
        turns.on_command(following, height_changes=np.zeros(2, dtype=bool))


def test_poses_that_are_all_over_the_place_do_not_stop_the_first_turn(clock):
    rng, turns = np.random.default_rng(2), make(clock, topics='a', arrival_timeout=math.inf)
    assert until_due(clock, turns, lambda: HERE + rng.normal(0.0, 0.5, HERE.shape)) < 25.0
    assert turns.overdue and turns.no_command_sent


def test_rotations_are_averaged(clock):
    turns = make(clock, topics='a')
    for tick in range(20):
        turned = [rotation_matrix(0.5 + 0.01 * (-1) ** tick, 0.2, 0.0)] * 2
        turns.on_poses(10 * S + tick * S // 20, HERE, turned)
    assert turns.cameras_stand
    _, rotations = turns.mean_poses
    np.testing.assert_allclose(rotations[1], rotation_matrix(0.5, 0.2, 0.0), atol=1e-3)


def test_noisy_poses_that_end_are_averaged_and_those_of_a_move_are_not(clock):
    rng, turns = np.random.default_rng(0), make(clock, topics='a')
    for tick in range(40):
        clock.now += 0.04
        turns.on_poses(10 * S + tick * S // 25, HERE + rng.normal(0.0, 0.01, HERE.shape), [
            rotation_matrix(*rng.normal(0.0, 0.0175, 3)) for _ in HERE])
    assert not turns.cameras_stand
    clock.now += QUIET_S
    assert not delivered(turns, 11, 'before the last pose', 'a') and turns.cameras_stand
    positions, rotations = turns.mean_poses
    assert np.abs(positions - HERE).max() < 0.006
    assert np.abs(rotations[0] - np.eye(3)).max() < 0.01
    # The same poses, as a camera comes that says where it is while it moves.
    moving = make(clock, topics='a')
    for tick in range(40):
        moving.on_poses(20 * S + tick * S // 25, HERE + 0.03 * (tick - 39), [np.eye(3)] * 2)
    clock.now += QUIET_S
    assert not delivered(moving, 21, 'before the last pose', 'a') and moving.cameras_stand
    np.testing.assert_allclose(moving.mean_poses[0], HERE)


def test_a_clock_of_poses_that_leads_does_so_by_the_same_seconds_until_it_is_set(clock):
    turns = make(clock)
    for _ in range(60):
        clock.now += 0.05
        turns.on_poses(int((130 + clock.now) * S), HERE)
        assert not delivered(turns, 100 + clock.now, 'late', 'a')
    assert turns.clock_leads() == pytest.approx({'a': 30.0})
    # A single cloud may have waited in a queue.
    turns.on_cloud('a', int((130 + clock.now) * S), 'good')
    assert not turns.clock_leads()


def test_clouds_from_the_future_are_named_and_not_used(clock):
    turns = make(clock)
    for _ in range(60):
        clock.now += 0.05
        turns.on_poses(int((100 + clock.now) * S), HERE)
        turns.on_cloud('b', int((105 + clock.now) * S), 'of another clock')
        assert all(cloud == 'good'
                   for _, cloud in delivered(turns, 100 + clock.now, 'good', 'a'))
    assert turns.is_due() and list(turns.silent_topics()) == ['b']
    assert turns.clock_leads() == pytest.approx({'b': -5.0})
    # Without newer poses the clocks cannot be compared.
    clock.now += 3.0
    turns.on_command(HERE, height_changes=np.zeros(2, dtype=bool))
    assert delivered(turns, 100 + clock.now, 'later', 'a') == [('a', 'later')]


@pytest.mark.parametrize('rate', [5.0, 30.0])
def test_poses_that_came_late_once_and_then_no_more_stop_no_topic(clock, rate):
    turns = make(clock)
    # Some rigs publish poses only while they move; these waited in a queue for three seconds.
    stands(turns, 97.0, HERE)
    assert not delivered(turns, 100.0, 'soon', 'a')
    while clock.now < 4.0:
        clock.now += 1.0 / rate
        delivered(turns, 100 + clock.now, 'good', 'a')
    assert turns.is_due() and not turns.clock_leads()


def test_a_cloud_of_a_move_is_not_used_though_its_clock_leads(clock):
    turns = make(clock)
    # Poses come only while the cameras move.
    turns.on_poses(100 * S, HERE)
    turns.on_poses(100 * S + STEADY_NS, THERE)
    clock.now = 0.4
    turns.on_cloud('a', 130 * S, 'of the move')
    clock.now = 1.0
    assert not taken(turns)
    clock.now = 1.2
    assert delivered(turns, 130.8, 'later', 'a') == [('a', 'later')]


@for_any(30, seed=strategies.integers(0, 2 ** 32 - 1))
def test_whatever_happened_a_rig_that_works_gets_its_turn(seed):
    rng, clock = np.random.default_rng(seed), SimpleNamespace(now=0.0)
    turns = make(clock)
    for _ in range(rng.integers(1, 60)):
        clock.now += rng.exponential(1.0)
        stamp = int(rng.choice([0, 5 * S, 100 * S, 2 ** 62]) + rng.integers(0, 3 * S))
        what = rng.integers(6)
        if what == 0:
            turns.on_poses(stamp, rng.choice([HERE, THERE]))
        elif what < 3:
            turns.on_cloud('ab'[what - 1], stamp, 'noise')
        elif what == 3:
            if (cloud := turns.take_cloud()) is not None and rng.random() < 0.5:
                turns.refuse_cloud(cloud[0])
        elif what == 4 and turns.is_due():
            turns.on_command(THERE)
        elif what == 5:
            turns.drop_clouds()
    # From now on everything is as it should be.
    assert until_due(clock, turns, lambda: THERE, 50.0 - clock.now, 'ab') < 4.0


def test_a_cloud_that_was_taken_too_soon_is_taken_again_for_a_while(clock):
    turns = make(clock)
    stands(turns, 10, HERE)
    turns.on_cloud('b', 10 * S, 'other')
    # New clouds of the topic do not make the others wait for ever.
    for number, clock.now in enumerate((0.0, 0.5, 1.0)):
        turns.on_cloud('a', (10 + number) * S, number)
        assert turns.take_cloud() == ('a', number)
        assert turns.put_back('a', (10 + number) * S, number)
        assert turns.take_cloud(['a']) == (('b', 'other') if number == 0 else None)
    clock.now = 1.5
    assert turns.take_cloud() == ('a', 2) and not turns.put_back('a', 12 * S, 2)
    turns.refuse_cloud('a')
    # Another one is asked for, and a newer one is not given up for it.
    assert turns.take_cloud() is None
    turns.on_cloud('a', 13 * S, 'next')
    assert turns.take_cloud() == ('a', 'next')
    turns.on_cloud('a', 14 * S, 'newer')
    assert turns.put_back('a', 13 * S, 'next') and turns.take_cloud() == ('a', 'newer')
