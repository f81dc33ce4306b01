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

"""README and pages of docs show what the files in docs/results hold."""

from decimal import Decimal
from functools import cache
import json
import re

from benchmarks.calibration_conditions import PAGE, page_of
from conftest import ROOT
import pytest

README, RESULTS, ENGINE = 'README.md', 'docs/results.md', 'docs/explanation/engine.md'
MODELS = 'docs/reference/models.md'
OVER_ROS = 'docs/tasks/train_over_ros.md'
ROBUSTNESS, SECURITY = 'docs/reference/robustness.md', 'docs/explanation/security.md'
NUMBER = r'(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?'

#: Tables: page, how the line with the columns begins, the name of each row in the file, and where
#: the number of each column is: FILE/KEY/KEY for one row, and its keys.
TABLES = [
    (README, '| with a scan', 'rig_search differential_evolution tdsa bpso greedy_coverage',
     'benchmark/planners/{row}/1000/{key}', 'regret seconds'),
    (RESULTS, '| method', 'fine fast paper hidden_point_removal', 'engine/{key}',
     'f1/{row}.15000 f1/{row}.40000 f1/{row}.100000 ms/{row}.40000'),
    (RESULTS, '| planner | regret',
     'differential_evolution rig_search bee_colony cma_es greedy_swap tdsa '
     'bpso regular_grid random greedy_coverage',
     'benchmark/planners/{row}/{key}',
     '100/regret 1000/regret 1000/promise_over_delivered 1000/seconds'),
    (RESULTS, '| four cameras', '4_5x2 4_8x2 4_30x0.5',
     'agent/comparisons/four/summary/settings/{row}/{key}',
     'lookahead/ratio lookahead/interval/0 lookahead/interval/1'),
    (RESULTS, '| turns of four cameras', '4_5x2 4_8x2 4_30x0.5',
     'agent/comparisons/explorers/summary/settings/{row}/{key}',
     'random/ratio random/interval/0 random/interval/1 alone/ratio'),
    (RESULTS, '| rig, 8 turns', '2_8x2 6_8x2 four_d455_8x2',
     'agent/comparisons/others/summary/settings/{row}/lookahead/{key}',
     'ratio interval/0 interval/1'),
    (RESULTS, '| planner, evaluations', 'tdsa_100 tdsa_1000 bpso_100 bpso_1000 regular_grid_100 '
     'random_100 lookahead', 'agent/comparisons/test/summary/settings/{key}',
     ' '.join(f'{length}/{{row}}/{key}' for length in ('4_30x0.5', '4_8x2')
              for key in ('ratio', 'interval/0', 'interval/1', 'won'))),
    (RESULTS, '| scan |',
     'tripod.realsense tripod.azure hand.realsense hand.azure real.realsense real.azure',
     'calibration/shares/{row}.{key}', 'alone.right alone.refused alone.wrong together.right '
     'together.refused together.wrong'),
    (RESULTS, '| without a scan', 'none.realsense none.azure', 'calibration/shares/{row}.{key}',
     'mutual.right mutual.refused mutual.wrong moved.right still.right'),
    (RESULTS, '| rig | plan', 'd455_walls d455_stands all_round_stands',
     'measure/plans/rigs/{row}/{key}', 'plan_over_lookahead plan_over_lookahead_worst '
     'plan_over_truth expected_mean promise_coverage certificate_gap'),
    (RESULTS, '| cameras, speed', ' '.join(
        f'{rig}.{case}' for rig in ('around', 'four_d455') for case in (
            'faster_than_thinking', 'slower_than_thinking', 'faster_and_waiting_for_plans')),
     'nodes/value/{row}/{key}', 'wall_s/0 wall_s/1'),
    (RESULTS, '| pixels, clouds per second', '640x480.5 640x480.15 1280x720.5 1280x720.15',
     'nodes/clouds/{row}/{key}',
     'clouds_per_s_of_a_camera turns_with_all_cameras cores memory_mb'),
    (RESULTS, '| area', '6 12 24', 'floors/floors/{row}/{key}',
     'rooms cameras seen least_seen_in_a_room gap seconds'),
    (RESULTS, '| counted on', '5_rooms 17_rooms', 'floors/counted/floors/{row}/{key}',
     'rooms cameras at_least fewer_tried least_share_of_a_room seconds'),
    (RESULTS, '| requirement',
     'recognise depth_15mm depth_4mm_incidence_75 two_from_30_degrees one_may_fail',
     'requirements/requirements/{row}/{key}',
     'asked promised_met met clear_verdict_right clear_verdicts delivered_over_promised'),
    (RESULTS, '| kind |', 'view_through_a_window glass_partition drifted_scan attic '
     'low_ceiling stray_points plain_room thinned_scan las_units colours_first decimal_commas '
     'counting_column survey_table thousands ragged_lines gltf_extensions unit_in_comment splats',
     'rooms_read/kinds/{row}/{key}',
     'after/right after/wrong'),
    (MODELS, '| repairs', 'literal_60000_0 critics_60000_0 updates_60000_0 blocks_60000_0 '
     'augmented_60000_0 augmented_300000_0 wide_300000_0', 'ladder/rows/{row}/{key}',
     'interactions ratio least_ratio'),
    (SECURITY, '| class |', 'E57 glTF OBJ PLY YAML text weights LAS bag cloud',
     'hostile_files/classes/{row}/{key}', 'read refused')]
#: Numbers in sentences: page, words around them, and where they are.
SENTENCES = [
    (README, 'Their depth error is {} times that of the same cameras moved without a scan '
     '(`lookahead`, below), and {} times that of a search',
     'measure/plans/rigs/d455_walls/{key}', 'plan_over_lookahead plan_over_truth'),
    (README, 'In a share of {} of the rooms the error is in the expected interval',
     'measure/plans/rigs/d455_walls/{key}', 'promise_coverage'),
    (README, 'have {} times the error of cameras that explore by random moves, the search being '
     'equal, after 30 turns of up to 0.5 m, and {} times after 5 turns',
     'agent/comparisons/explorers/summary/settings/{key}/random/ratio', '4_30x0.5 4_5x2'),
    (README, 'they have {} times the error of TDSA with 100 evaluations and {} times that of '
     'binary PSO with 1,000', 'agent/comparisons/test/summary/settings/4_30x0.5/{key}/ratio',
     'tdsa_100 bpso_1000'),
    (README, 'it takes {} ms per camera, and its F1 score against ray casting is {}',
     'engine/{key}/fine.40000', 'ms f1'),
    (ENGINE, 'plans with `mesh` have {} times the error of plans with `fine` on sampled points, '
     'at {} instead of {} ms', 'solid_rooms/{key}', 'delivered_mesh_over_fine ms_mesh ms_fine'),
    (ENGINE, 'the shares are {}, {} and {}', 'false_visibility/means/{key}/blocked',
     'all proved proved_known_scans'),
    (ENGINE, 'F1 is {}, {} and {}', 'false_visibility/means/{key}/f1',
     'all proved proved_known_scans'),
    (RESULTS, "the integral is {}. When the scan is turned by 17 or 45 degrees, the engine's "
     'error changes by at most {} of its value', 'measure/viewpoints/air/{key}',
     'rank_correlation turned_objective_change_worst'),
    (RESULTS, 'in a turned scan is {} times that of a plan in the original scan (geometric mean; '
     '{} at worst)', 'measure/{key}', 'turned_delivered_ratio turned_delivered_ratio_worst'),
    (RESULTS, 'in the air the ratio is {}, {} and {}', 'measure/stray_delivered_ratio/{key}',
     '0.002 0.01 0.05'),
    (RESULTS, 'is {} of the delivered one, and {} and {} in scans',
     'measure/promise_over_delivered/{key}', 'turned_0 turned_17 turned_45'),
    (RESULTS, 'the promised error of {} plans is {}', 'measure/plans/scans/{key}',
     'plans promise_mean'),
    (RESULTS, 'on ceilings have {} and {} times the error of a greedy choice',
     'measure/crowds/rows/{key}', '0/plan_over_greedy_error 2/plan_over_greedy_error'),
    (RESULTS, 'evaluates {} placements of four cameras per second', 'engine/{key}',
     'evaluations_per_s'),
    (RESULTS, 'method plays {} interactions', 'engine/{key}', 'literal_interactions_per_s'),
    (RESULTS, 'its mean optimality gap is {}. Of planners without a scan, `lookahead` has a '
     'regret of {} and `learned` of {} after 30 turns', 'benchmark/planners/{key}',
     'rig_search/1000/gap lookahead/0/regret learned/0/regret'),
    (RESULTS, '{} m in {} s, `tdsa` {} m in {} s. Without a scan `learned` delivers {} m and '
     '`lookahead` {} m', 'benchmark_four_d455/planners/{key}',
     'rig_search/300/sum rig_search/300/seconds tdsa/300/sum tdsa/300/seconds learned/0/sum '
     'lookahead/0/sum'),
    (RESULTS, 'the final depth error is {}, {} and {} times that of a search that knows the room '
     '(at worst {}, {} and {})', 'nodes/rooms/{key}',
     '0/ratio 1/ratio 2/ratio 0/ratio_worst 1/ratio_worst 2/ratio_worst'),
    (RESULTS,
     '{} ms (median) with four cameras and {} points, and {} ms with eight cameras and {} points',
     'studio/sizes/{key}',
     '0/event_to_colours_ms/p50 0/points 1/event_to_colours_ms/p50 1/points'),
    (RESULTS, '99 % take at most {} and {} ms', 'studio/sizes/{key}',
     '0/event_to_colours_ms/p99 1/event_to_colours_ms/p99'),
    (RESULTS, 'the ratio to `lookahead` is {} after 8 turns of 2 m and {} after 30 turns',
     'agent/comparisons/scans/summary/settings/{key}/lookahead/ratio', '4_8x2 4_30x0.5'),
    (RESULTS, 'is {} times that of `lookahead` (95 % interval {} to {})',
     'agent/pooled/lookahead/{key}', 'ratio interval/0 interval/1'),
    (MODELS, 'those after {} of the 300,000 interactions', 'agent/model/{key}', 'interactions'),
    (MODELS, 'is {} times that at the start. A second training (seed 1) reaches {}',
     'training/seeds/{key}/ratio', '0 1'),
    (OVER_ROS, 'falls from {} after {} turns to {} after {} turns',
     'training/over_ros/error_ratio_by_turns/{key}', '2/1 2/0 19/1 19/0'),
    (MODELS, 'augmented samples has {} after {} interactions',
     'ladder/rows/augmented_180000_1/{key}', 'ratio interactions'),
    (ROBUSTNESS, '{} malformed messages among {} valid', 'drills/fuzz/{key}',
     'messages good_messages_answered'),
    (ROBUSTNESS, '{} turns, {} nodes killed, {} malformed messages', 'drills/soak/{key}',
     'turns restarts_survived malformed_messages_sent'),
    (ROBUSTNESS, '{} s (median), {} s at most; memory grew by {} MB', 'drills/soak/{key}',
     'recovery_seconds_p50 recovery_seconds_max rss_growth_mb'),
    (ROBUSTNESS, '{} files with random errors: {} read, {} rejected', 'drills/file_fuzz/{key}',
     'mutations read refused'),
    (ROBUSTNESS, '{} sessions of the studio and {} plans: memory grew by {} and {} MB',
     'drills/one_process/{key}', 'sessions/repetitions plans/repetitions '
     'sessions/memory_growth_mb plans/memory_growth_mb')]


@cache
def content(name):
    """Return what a file of results holds."""
    return json.loads((ROOT / 'docs' / 'results' / f'{name}.json').read_text())


def value(path):
    """Return the number at FILE/KEY/KEY, or None where the file does not have it."""
    name, *keys = path.split('/')
    found = content(name)
    for key in keys:
        found = found[int(key)] if isinstance(found, list) else found.get(key, {})
    return None if found == {} else found


def compare(shown, where, keys, row=''):
    """Compare numbers of a page with those of a file, rounded to the digits shown."""
    values = [value(where.format(row=row, key=key.format(row=row))) for key in keys.split()]
    values = [found for found in values if found is not None]
    assert len(shown) == len(values), (shown, values)
    for text, found in zip(shown, values):
        number = Decimal(text.replace(',', ''))
        digit = Decimal(1).scaleb(number.as_tuple().exponent)
        assert 2 * abs(number - Decimal(str(found))) <= digit, (text, found)


@pytest.mark.parametrize('page, head, rows, where, keys', TABLES)
def test_tables_show_the_files(page, head, rows, where, keys):
    lines = (ROOT / page).read_text().split(f'\n{head}', 1)[1].split('\n\n', 1)[0].splitlines()[2:]
    assert len(lines) == len(rows.split())
    for line, row in zip(lines, rows.split()):
        label, *cells = line.strip('| ').split('|')
        names = re.findall(r'`(\w+)`', label)
        assert not names or row in names, line
        compare(re.findall(NUMBER, ' '.join(cells)), where, keys, row)


@pytest.mark.parametrize('page, words, where, keys', SENTENCES)
def test_sentences_show_the_files(page, words, where, keys):
    text = ' '.join((ROOT / page).read_text().split())
    found = re.search(re.escape(words).replace(r'\{\}', f'({NUMBER})'), text)
    assert found, words
    compare(found.groups(), where, keys)


def test_the_hostile_files_are_those_of_the_page():
    found = value('hostile_files/classes').values()
    read, rejected = (sum(kind[key] for kind in found) for key in ('read', 'refused'))
    text = (ROOT / SECURITY).read_text()
    assert f'Of {read + rejected} files, {read} were read and {rejected} rejected' in text
    assert not any(kind[key] for kind in found for key in ('wrong', 'crashed', 'hung', 'leaked'))


def test_the_robustness_page_shows_the_dates_of_the_drills():
    rows = (ROOT / ROBUSTNESS).read_text().split('\n| drill |', 1)[1].splitlines()
    for name, part in content('drills').items():
        assert any(f'`{name}`' in row and f'| {part["date"]} |' in row for row in rows), name


def test_the_page_of_conditions_shows_its_file():
    assert PAGE.read_text() == page_of(content('calibration_conditions'))


def test_the_readme_shows_few_numbers():
    shown = [len(keys.split()) for page, *_, keys in SENTENCES if page == README]
    shown += [len(rows.split()) * len(keys.split())
              for page, _, rows, _, keys in TABLES if page == README]
    assert sum(shown) <= 20


@pytest.mark.parametrize('path', sorted((ROOT / 'docs' / 'results').glob('*.json')),
                         ids=lambda path: path.stem)
def test_each_file_says_how_it_was_measured(path):
    document = json.loads(path.read_text())
    for part in [document] if 'date' in document else document.values():
        assert part['command'] and part['date'] and (part.get('commit') or part.get('commits'))
