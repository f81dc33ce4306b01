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

"""The studio without its page: states, evaluation, searches, zones and files."""

from conftest import HUNG, printed
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.report.drawing.depth_image import depth_colours, depth_image
from ocp_ros.report.facts import region_rows
from ocp_ros.report.terminal import as_text, show_score
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.studio import tasks, texts, zone_edits
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import State, Studio
from ocp_ros.util.settings import ConfigurationError
import pytest

D455 = 'realsense_d455'


def move(studio, camera=0, by=(0.3, 0.1, 0.0, 0.2, 0.0, 0.0), action=None):
    assert studio.move_camera(camera, studio.state.poses[camera] + np.array(by), action)


def test_the_page_shows_the_numbers_that_ocp_score_prints(studio, tmp_path, capsys):
    floor = studio.evaluation().problem.region.floor
    studio.set_rig(**zone_edits.added_box(studio.state.rig, 'regions', studio.scene, floor))
    entry, = zone_edits.entries_of(studio.state.rig)
    studio.set_rig(**zone_edits.changed_entry(studio.state.rig, entry, must_see=1.0, weight=2.0))
    move(studio, by=(0.31234, -0.2, -0.7, 0.123456, 0.05, 0.0))
    path = Folder(tmp_path).save_placement('mine', studio.placement(True))
    evaluation = studio.evaluation()
    found = printed(capsys, 'score', '3', path)
    assert evaluation.all_violations and found['broken'] == evaluation.all_violations
    assert found['scores'] == evaluation.scores
    assert found['expected'] == evaluation.expected_error
    assert found['scores']['loss'] == evaluation.rig_evaluation.loss
    assert not [note for note in found['notes'] if 'objective value' in note]
    lines = as_text(show_score, found).splitlines()
    for label, value in texts.figures_of(evaluation):
        shown, _, remark = value.rstrip(')').partition(' (')
        assert any(label in line and shown in line and remark in line for line in lines), label
    for row in region_rows(evaluation.scores):
        assert any(all(cell in line for cell in row) for line in lines), row


def test_only_the_moved_camera_looks_again_and_all_is_as_if_all_had(studio, monkeypatch):
    studio.evaluation()
    looks, look = [], Simulator.look
    monkeypatch.setattr(Simulator, 'look', lambda self, pose, camera=0: (
        looks.append(camera), look(self, pose, camera))[1])
    for camera in (0, 2, 1, 0):
        move(studio, camera)
        evaluation = studio.evaluation()
    assert looks == [0, 2, 1, 0]
    fresh = Studio(studio.scene, studio.room, studio.state.rig, studio.state.poses).evaluation()
    assert fresh.scores == evaluation.scores
    assert np.array_equal(fresh.camera_counts, evaluation.camera_counts)
    seen = np.sum([evaluation.points_seen_by(camera) for camera in range(3)], axis=0)
    assert np.array_equal(evaluation.camera_counts, seen)
    looks.clear()
    studio.history.undo()
    studio.evaluation()
    assert not looks


def test_undo_and_redo(studio):
    first = studio.state
    # The steps of one drag are undone together.
    for _ in range(5):
        move(studio, action='drag 1')
    second = studio.state
    move(studio, action='drag 2')
    assert studio.history.undo() and studio.state is second
    assert studio.history.undo() and studio.state is first
    assert not studio.history.undo()
    assert studio.history.redo() and studio.state is second
    studio.add_camera(D455)
    assert not studio.history.redo()
    for _ in range(300):
        studio.history.set_present(State(first.rig, first.poses))
    assert len(studio.history.past_states) == 200


@pytest.mark.parametrize('value', [1e308, -1e306, 1e30, 700.0])
def test_any_number_gives_a_placement_that_a_file_may_have(studio, tmp_path, value):
    for axis in range(6):
        pose = studio.state.poses[0].copy()
        pose[axis] = value
        assert studio.move_camera(0, pose)
        studio.add_camera(D455, pose)
    path = Folder(tmp_path).save_placement('moved', studio.placement(scored=True))
    assert np.allclose(load_placement(path).poses, studio.state.poses)
    assert np.abs(studio.state.poses[:, 4]).max() <= 0.5 * np.pi
    before = studio.state
    for poses in (before.poses * np.nan, before.poses + 1e6):
        with pytest.raises(ConfigurationError, match='poses'):
            studio.set_placement(before.rig, poses)
    assert studio.state is before


def test_a_placement_that_cannot_be_evaluated_does_not_become_the_present_one(
        studio, monkeypatch):
    before, look = studio.state, Simulator.look

    def fails(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(Simulator, 'look', fails)
    with pytest.raises(ZeroDivisionError):
        move(studio)
    monkeypatch.setattr(Simulator, 'look', look)
    assert studio.state is before and not studio.history.past_states
    move(studio)


def test_cameras_are_added_copied_exchanged_and_removed(studio):
    camera = studio.add_camera('kinect_v2')
    assert camera == 3 and studio.state.names[3] == 'kinect_v2'
    assert studio.state.rig.cameras[3].sensor == 'kinect_v2'
    assert not studio.evaluation().violations
    copy = studio.add_camera('kinect_v2', studio.state.poses[3] + 0.1)
    assert studio.state.names[copy] == 'kinect_v2_1'
    assert studio.state.rig.cameras[copy].model == studio.state.rig.cameras[3].model
    before = studio.evaluation().rig_evaluation.loss
    studio.set_sensor(3, 'realsense_l515')
    assert studio.evaluation().rig_evaluation.loss != before
    with pytest.raises(ConfigurationError, match='sensor'):
        studio.set_sensor(3, 'no such sensor')
    assert studio.state.rig.cameras[3].sensor == 'realsense_l515'
    names = studio.state.names
    studio.remove_camera(0)
    assert studio.state.names == names[1:]
    assert len(studio.evaluation().scores['cameras']) == 4
    for _ in range(3):
        studio.remove_camera(0)
    with pytest.raises(ConfigurationError, match='cameras'):
        studio.remove_camera(0)


def test_a_dragged_camera_keeps_its_roll_while_its_direction_changes(studio):
    pose = studio.state.poses[0]
    about_up = rotation_matrix(*pose[3:]) @ rotation_matrix(0.5, 0.0, 0.0)
    turned = studio.dragged_pose(0, pose[:3], about_up)
    assert turned[5] == pose[5] and turned[3] != pose[3]
    rolled = studio.dragged_pose(0, pose[:3], rotation_matrix(pose[3], pose[4], 0.4))
    assert rolled[5] == pytest.approx(0.4)


def test_a_camera_where_none_may_be_has_a_sentence_and_a_nearest_allowed_pose(studio):
    move(studio, by=(0.0, 0.0, 2.0, 0.0, -1.0, 0.0))
    evaluation = studio.evaluation()
    assert any('mount.height' in line for line in evaluation.violations)
    near = studio.nearest_allowed(evaluation, 0)
    assert np.linalg.norm(near[:2] - evaluation.state.poses[0, :2]) < 0.5
    studio.move_camera(0, near)
    assert not studio.evaluation().violations
    # From outside the room, too.
    move(studio, by=(30.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    evaluation = studio.evaluation()
    assert evaluation.violations
    studio.move_camera(0, studio.nearest_allowed(evaluation, 0))
    assert not studio.evaluation().violations


def test_zones_are_added_moved_and_removed(studio):
    floor = studio.evaluation().problem.region.floor
    for key in ('keep_out', 'regions'):
        studio.set_rig(**zone_edits.added_box(studio.state.rig, key, studio.scene, floor))
    region, zone = zone_edits.entries_of(studio.state.rig)
    assert (region.label, zone.label) == ('region region_1', 'keep-out zone 1')
    target = zone.zone.corners(floor).mean(axis=0) + [0.0, 0.5, 0.0]
    studio.set_rig(**zone_edits.moved_box(studio.state.rig, zone, target))
    _, moved = zone_edits.entries_of(studio.state.rig)
    assert moved.zone.corners(floor).mean(axis=0) == pytest.approx(target, abs=2e-3)
    studio.set_rig(**zone_edits.changed_entry(studio.state.rig, region, must_see=1.0))
    assert studio.state.rig.regions[0].must_see == 1.0
    assert studio.evaluation().unseen_required_points().any()
    with pytest.raises(ConfigurationError, match='found no points'):
        studio.set_rig(**zone_edits.moved_box(studio.state.rig, region, target + 90.0))
    assert studio.state.rig.regions[0].must_see == 1.0
    studio.set_rig(**zone_edits.removed_entry(studio.state.rig, zone))
    assert not studio.state.rig.keep_out


def test_colours_show_counts_requirements_and_the_selected_camera(studio):
    evaluation = studio.evaluation()
    for paint in texts.COLOURINGS:
        colours = texts.point_colours(evaluation, paint, 0)
        legend = {texts.rgb(colour) for _, colour in texts.LEGENDS[paint]}
        assert colours.shape == (len(studio.scene), 3) and colours.dtype == np.uint8
        assert set(map(tuple, np.unique(colours, axis=0).tolist())) <= legend
    colours = texts.point_colours(evaluation, texts.COLOURINGS.by_count, 0)
    missed = (colours == texts.rgb(texts.UNSEEN_COLOUR)).all(axis=1)
    assert np.array_equal(missed, evaluation.camera_counts == 0)


def test_the_depth_image_has_the_distance_of_what_a_camera_sees(studio):
    evaluation = studio.evaluation()
    seen = studio.point_order[evaluation.points_seen_by(0)]
    pose, model = evaluation.state.poses[0], evaluation.problem.models[0]
    image = depth_image(studio.scene.points[seen], studio.scene.pitch[seen], pose, model)
    known = np.isfinite(image)
    assert known.mean() > 0.2 and image[known].max() <= model.max_range
    ahead = pose[:3] + [np.cos(pose[3]), np.sin(pose[3]), 0.0]
    one = depth_image(ahead[None], np.array([0.01]), np.array([*pose[:4], 0.0, 0.0]), model)
    assert one[np.isfinite(one)] == pytest.approx(1.0)
    middle = np.argwhere(np.isfinite(one)).mean(axis=0)
    assert middle == pytest.approx(np.array(one.shape) / 2, abs=1)
    assert depth_colours(image, model).shape == (*image.shape, 3)


def news_of(work, seconds=0.6):
    """Run a task to its end; return its news."""
    news = []
    task = tasks.Task(work, seconds, news.append)
    task.join()
    assert news[-1].ended
    return news


def better_poses(studio, seconds=0.6):
    """Search for better poses, and return the last ones that are found, or the present ones."""
    news = news_of(tasks.search_work(studio, studio.state), seconds)
    return [studio.state.poses, *(one.poses for one in news if one.poses is not None)][-1]


def test_planning_improves_the_placement_and_shows_each_better_one(studio):
    before, losses = studio.evaluation().rig_evaluation.loss, []
    news = news_of(tasks.search_work(studio, studio.state))
    for one in news:
        if one.poses is not None:
            studio.set_placement(studio.state.rig, one.poses)
            losses.append(studio.evaluation().rig_evaluation.loss)
            assert not studio.evaluation().violations
    assert losses[-1] < before and losses == sorted(losses, reverse=True)
    assert [one.share for one in news] == sorted(one.share for one in news)
    # A shorter search that finds nothing better leaves the placement as it is.
    studio.set_placement(studio.state.rig, better_poses(studio, 0.01))
    assert studio.evaluation().rig_evaluation.loss <= losses[-1]


def test_a_proof_says_how_far_any_placement_of_the_rig_is_from_the_best(studio_room):
    studio = Studio(*studio_room, rig_of(1, mount={'on': 'plane'}))
    seconds = 0.5
    while (certificate := studio.certificate(studio.evaluation())) is None:
        studio.set_placement(studio.state.rig, better_poses(studio, seconds))
        seconds *= 2.0
    assert 'is better by more than' in texts.all_figures(studio.evaluation(), certificate)
    move(studio, by=(0.3, 0.3, 0.0, 0.0, 0.0, 0.0))
    worse = studio.certificate(studio.evaluation())
    assert worse.gap > certificate.gap and worse.bound == certificate.bound
    studio.add_camera('omnidirectional')
    assert studio.certificate(studio.evaluation()) is None
    assert texts.NO_CERTIFICATE in texts.all_figures(studio.evaluation(), None)


def test_an_edit_and_a_search_leave_locked_cameras_where_they_are(studio):
    studio.set_locked(1, True)
    assert not studio.move_camera(1, studio.state.poses[1] + 0.1)
    before = studio.evaluation().rig_evaluation.loss
    poses = better_poses(studio)
    assert np.array_equal(poses[1], studio.state.poses[1])
    assert not np.array_equal(poses[0], studio.state.poses[0])
    studio.set_placement(studio.state.rig, poses)
    assert studio.evaluation().rig_evaluation.loss < before
    for camera in range(3):
        studio.set_locked(camera, True)
    assert 'locked' in news_of(tasks.search_work(studio, studio.state))[-1].message
    studio.set_locked(1, False)
    move(studio, 1)


def test_a_search_from_a_pose_that_is_not_allowed_begins_at_the_nearest_one(studio):
    move(studio, by=(0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    studio.set_placement(studio.state.rig, better_poses(studio))
    assert not studio.evaluation().violations


def test_a_search_is_stopped(studio):
    news = []
    task = tasks.Task(tasks.search_work(studio, studio.state), HUNG, news.append)
    task.stop()
    task.join()
    assert news[-1].ended


def test_the_best_additional_camera_is_that_of_ocp_score(studio, tmp_path, capsys):
    path = Folder(tmp_path).save_placement('mine', studio.placement(True))
    before, added = studio.evaluation().rig_evaluation.depth_error, []
    news_of(tasks.addition_work(studio.evaluation(), lambda *more: added.extend(more)))
    sensor, pose = added
    more = printed(capsys, 'score', '3', path)['one_more']
    assert pose[:3].tolist() == more['position']
    studio.add_camera(sensor, pose)
    after = studio.evaluation().rig_evaluation.depth_error
    assert after < before and after == pytest.approx(more['depth_error'], rel=0.01)


def test_the_camera_to_leave_out_costs_least(studio):
    camera, loss = tasks.find_least_useful(studio.evaluation())
    losses = []
    for other in range(3):
        left = Studio(studio.scene, studio.room, studio.state.rig, studio.state.poses)
        left.remove_camera(other)
        losses.append(left.evaluation().rig_evaluation.loss)
    assert losses[camera] == loss and min(losses) >= loss - 1e-12


def test_files_are_saved_loaded_and_exported(studio, tmp_path, undrawn):
    folder = Folder(tmp_path)
    studio.set_sensor(0, 'kinect_v2')
    move(studio)
    loss, poses = studio.evaluation().rig_evaluation.loss, studio.state.poses
    folder.save_placement('mine', studio.placement(True))
    folder.save_rig('my_rig', studio.state.rig)
    studio.replace_rig(*folder.load('my_rig.yaml', studio.scene))
    assert not np.array_equal(studio.state.poses, poses)
    studio.replace_rig(*folder.load('mine.yaml', studio.scene))
    assert np.array_equal(studio.state.poses, poses)
    assert studio.evaluation().rig_evaluation.loss == loss
    (tmp_path / 'bad.yaml').write_text('cameras: 3\n')
    with pytest.raises(ConfigurationError, match='bad.yaml'):
        folder.load('bad.yaml', studio.scene)
    files = folder.export('all', studio.scene, studio.placement(True), 'ocp studio')
    assert {'placement.yaml', 'cameras.launch.py', 'installer.md', 'report.html'} <= set(
        files) <= {path.name for path in (tmp_path / 'all').iterdir()}


def test_a_rig_with_cameras_in_place_and_groups_keeps_them(studio_room):
    rig = rig_of(2, D455, mount={'on': 'free'}, fixed=[
        {'sensor': 'kinect_v2', 'position': [2.0, 2.0, 2.0]}])
    studio = Studio(*studio_room, rig)
    names, expected = ([camera.name for camera in one.all_cameras]
                       for one in (studio.state.rig, rig))
    assert names == expected and studio.state.rig.models == rig.models
    assert studio.evaluation().scores['cameras'][2]['name'] == 'kinect_v2'
    assert np.linalg.norm(studio.state.poses[:, :3] - [2.0, 2.0, 2.0], axis=1).min() > 0.2
