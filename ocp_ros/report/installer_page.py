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

"""The installer's page: where to mount each camera, as Markdown."""

from html import escape
import re

import numpy as np
from ocp_ros.report import fill_template
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import INSTRUCTION_COLUMNS, lens_text
from ocp_ros.report.facts import page_facts_of
from ocp_ros.util.files import printable


def escape_markdown(text: str) -> str:
    """Return a text, which may come from a file, as one line of Markdown without markup."""
    # Characters that begin or end markup within a line; an underscore between letters does not.
    # The colon of http://, the dot of www. and @ would make a link of the text around them.
    markup = r'[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.|@'
    return re.sub(markup, r'\\\g<0>', escape(printable(text), quote=False))


def installer_page(assessed: Assessment, plan: str) -> str:
    """
    Return the installer's page as Markdown: mounting instructions, and a plan with letters.

    :param assessed: the placement in its room.
    :param plan: file name of the plan's picture in the same folder.
    """
    facts = page_facts_of(assessed)
    cameras = assessed.placement.cameras
    rig = assessed.objective.rig
    floors = assessed.floors
    mounts = {'walls': 'on walls', 'ceiling': 'under the ceiling',
              'plane': 'on stands, poles or rods, all at one height',
              'free': 'on stands, poles or rods'}
    corner_position = assessed.frame.to_source(
        np.append(assessed.corner.position, floors.height)).round(2)
    # Optional sentences of the page.
    surfaces = ', '.join(
        wall.description(assessed.walls, float(floors.under(wall.position[None])[0]))
        for wall in assessed.references.inner)
    # A mount that the rig file does not give is not named.
    mount = '' if 'mount' not in rig.document.data else (
        f'**Mount.** The cameras are {mounts[rig.mount.on]}. The room is '
        f'{100.0 * (assessed.scene.bounds[1, 2] - floors.height):.0f} cm high.\n\n')
    advice = ' Unless the table gives a roll, keep the long side of the camera level, top side up.'
    table = [['', *INSTRUCTION_COLUMNS], ['---'] * (len(INSTRUCTION_COLUMNS) + 1),
             *(map(escape_markdown, row) for row in assessed.rows)]
    return fill_template(
        'installer.md', room=escape_markdown(assessed.scene.name), plan=plan, walls=facts.walls,
        doubts=''.join(f'**Check first:** {escape_markdown(doubt)}.\n\n'
                       for doubt in facts.doubts),
        inner_walls=f' Other surfaces to measure from: {surfaces}.' if surfaces else '',
        mount=mount,
        level='' if all(placed.camera.model.omnidirectional for placed in cameras) else advice,
        frame=facts.frame, corner=assessed.corner.letters,
        # Adding 0 turns -0.0 into 0.0.
        corner_at=', '.join(f'{value + 0.0:.2f}' for value in corner_position),
        table='\n'.join(f'| {" | ".join(row)} |' for row in table),
        lenses='\n'.join(f'- {escape_markdown(placed.camera.name)}: '
                         + '; '.join(filter(None, (lens_text(placed.camera.model), aim)))
                         for placed, aim in zip(cameras, assessed.aims)),
        # The first three, in the order of ``score_figures``: the depth error on the scan, the
        # expected one, and the share of seen points.
        figures='; '.join(f'{label} {value} ({remark})'
                          for label, value, remark in facts.figures[:3]),
        certificate=f' {escape_markdown(facts.certificate)}'.rstrip(),
        origin=escape_markdown(facts.origin))
