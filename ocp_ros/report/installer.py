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
The installer's page: mounting instructions for each camera, and a plan with lettered walls.

Its text is ``templates/installer.md``.
"""

from html import escape
import re

import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import COLUMNS, lens_of
from ocp_ros.report.facts import page_facts_of
from ocp_ros.report.templates import fill_template
from ocp_ros.util.terminal_text import printable

#: Mount of the cameras in words, by the rig file's ``mount.on``.
MOUNTED = {'walls': 'on walls', 'ceiling': 'under the ceiling',
           'plane': 'on stands, poles or rods, all at one height',
           'free': 'on stands, poles or rods'}
#: Characters that begin or end markup within a line; an underscore between letters does not.
MARKS = re.compile(r'[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.|@')


def in_markdown(text: str) -> str:
    """Return an untrusted text as one line of Markdown, with all markup escaped."""
    return MARKS.sub(r'\\\g<0>', escape(printable(text), quote=False))


def instructions(assessed: Assessment, plan: str) -> str:
    """
    Return the installer's page as Markdown.

    :param assessed: the placement in its room.
    :param plan: file name of the plan beside it.
    """
    facts, cameras, corner = page_facts_of(assessed), assessed.placement.cameras, assessed.corner
    rig, floor = assessed.objective.rig, assessed.floor
    corner_at = assessed.frame.to_source(np.append(corner.at, floor)).round(2)
    inner = ', '.join(wall.description(assessed.walls, floor)
                      for wall in assessed.references.inner)
    mount = f'**Mount.** The cameras are {MOUNTED[rig.mount.on]}. The room is ' \
            f'{100.0 * (assessed.scene.bounds[1, 2] - floor):.0f} cm high.\n\n'
    level = ' Unless the table gives a roll, keep the long side of the camera level, top side up.'
    table = [['', *COLUMNS], ['---'] * (len(COLUMNS) + 1),
             *(map(in_markdown, row) for row in assessed.rows)]
    return fill_template(
        'installer.md', room=in_markdown(assessed.scene.name), plan=plan, walls=facts.walls,
        doubts=''.join(f'**Check first:** {in_markdown(doubt)}.\n\n' for doubt in facts.doubts),
        inner_walls=f' Other surfaces to measure from: {inner}.' if inner else '',
        mount=mount if 'mount' in rig.document.data else '',
        level='' if all(placed.camera.model.omnidirectional for placed in cameras) else level,
        frame=facts.frame, corner=corner.letters,
        # Adding 0 turns -0.0 into 0.0.
        corner_at=', '.join(f'{value + 0.0:.2f}' for value in corner_at),
        table='\n'.join(f'| {" | ".join(row)} |' for row in table),
        lenses='\n'.join(f'- {in_markdown(placed.camera.name)}: '
                         + '; '.join(filter(None, (lens_of(placed.camera.model), aim)))
                         for placed, aim in zip(cameras, assessed.aims)),
        figures='; '.join(f'{label} {value} ({remark})'
                          for label, value, remark in facts.figures[:3]),
        certificate=f' {in_markdown(facts.certificate)}'.rstrip(),
        origin=in_markdown(facts.origin))
