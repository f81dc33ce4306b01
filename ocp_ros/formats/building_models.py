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

"""Cameras as sensors in a storey of a building model: IFC (ifcopenshell)."""

from pathlib import Path
from typing import Any

import numpy as np
from ocp_ros import __version__
from ocp_ros.formats.exported import Exported, pose_matrix
from ocp_ros.formats.scene_models import field_of_view_body
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.placement_file import Placed
from ocp_ros.scenes.building_files import storey_levels

#: Size of a camera's body, metres.
BODY_M = 0.1
#: The body of a camera: a pyramid whose tip is at the camera and which opens forward.
BODY = (BODY_M * np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.4], [1.0, -0.5, 0.4], [1.0, -0.5, -0.4],
                           [1.0, 0.5, -0.4]]),
        np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]))


def ifc_of(exported: Exported) -> str:
    """
    Return cameras as ``IfcSensor`` in a storey; in IFC2X3 as ``IfcDistributionControlElement``.

    If the room is an IFC file that still exists, the cameras are added to this model, in the
    highest storey below each camera. Otherwise it is a new one of IFC4 with a storey on the floor.
    The body of a field of view has the representation identifier ``Clearance``. The property set
    ``Ocp_DepthCamera`` has radians and metres.

    :raises ConfigurationError: if the model is a new one, and z of the files is not up.
    """
    import ifcopenshell
    from ifcopenshell.api import run
    from ifcopenshell.util.unit import calculate_unit_scale
    record = exported.original.room
    room = Path(record.get('file', ''))
    if room.suffix.lower() == '.ifc' and room.is_file():
        model = ifcopenshell.open(room)
        # From the map to the axes of the model, in metres.
        to_model = np.array(record.get('source_from_map', np.eye(4)), dtype=np.float64)
        to_model[:3] /= np.linalg.norm(to_model[:3, :3], axis=1, keepdims=True)
        matrices = [to_model @ pose_matrix(placed) for placed in exported.original.cameras]
    else:
        model = _new_model(exported)
        matrices = [pose_matrix(placed) for placed in exported.placement.cameras]
    scale = calculate_unit_scale(model)
    context = next((one for one in model.by_type('IfcGeometricRepresentationContext', False)
                    if one.ContextType == 'Model'), None) or run(
                        'context.add_context', model, context_type='Model')
    for number, placed in exported.cameras():
        _add_camera(model, context, placed, matrices[number], scale)
    return model.to_string()


def _new_model(exported: Exported) -> Any:
    """Return a model with a project, a site, a building and a storey, in metres."""
    import ifcopenshell
    from ifcopenshell.api import run
    exported.check_z_up('ifc')
    model = ifcopenshell.file(schema='IFC4')
    project = run('root.create_entity', model, ifc_class='IfcProject', name='ocp_ros')
    run('unit.assign_unit', model, length={'is_metric': True, 'raw': 'METERS'})
    run('context.add_context', model, context_type='Model')
    assessed, above = exported.assessed, project
    for kind, name in (('IfcSite', 'site'), ('IfcBuilding', 'building'),
                       ('IfcBuildingStorey', assessed.scene.name if assessed else 'storey')):
        inner = run('root.create_entity', model, ifc_class=kind, name=name)
        run('aggregate.assign_object', model, products=[inner], relating_object=above)
        above = inner
    floor = np.array([0.0, 0.0, assessed.floors.height if assessed else 0.0])
    above.Elevation = float(exported.to_file(floor)[2])
    matrix = np.eye(4)
    matrix[2, 3] = above.Elevation
    run('geometry.edit_object_placement', model, product=above, matrix=matrix)
    return model


def _add_camera(model: Any, context: Any, placed: Placed, matrix: np.ndarray, scale: float
                ) -> None:
    """Add a camera with a pose (4, 4) in metres; ``scale`` is metres per unit of the model."""
    from ifcopenshell.api import run
    camera, lens = placed.camera, placed.camera.model
    kind = 'IfcDistributionControlElement' if model.schema == 'IFC2X3' else 'IfcSensor'
    sensor = run('root.create_entity', model, ifc_class=kind, name=camera.name,
                 predefined_type='USERDEFINED')
    sensor.ObjectType = 'DEPTH_CAMERA'
    sensor.Description = camera.sensor or None
    storeys = storey_levels(model)
    below = [one for one in storeys if scale * one[0] <= matrix[2, 3] + 1e-6]
    if storeys:
        run('spatial.assign_container', model, products=[sensor],
            relating_structure=(below[-1] if below else storeys[0])[1])
    run('geometry.edit_object_placement', model, product=sensor, matrix=matrix)
    representations = []
    for identifier, (vertices, triangles) in (('Body', BODY),
                                              ('Clearance', field_of_view_body(lens))):
        representation = run('geometry.add_mesh_representation', model, context=context,
                             vertices=[vertices], faces=[triangles.tolist()], unit_scale=scale)
        representation.RepresentationIdentifier = identifier
        representations.append(representation)
    sensor.Representation = model.create_entity('IfcProductDefinitionShape', None, None,
                                                representations)
    properties = run('pset.add_pset', model, product=sensor, name='Ocp_DepthCamera')
    run('pset.edit_pset', model, pset=properties, properties=_properties_of(placed, lens))


def _properties_of(placed: Placed, lens: CameraModel) -> dict[str, Any]:
    """Return the properties of a camera: angles in radians, ranges in metres."""
    width, height = lens.resolution or (0, 0)
    return {'Sensor': placed.camera.sensor or 'own', 'Mount': placed.mount,
            'HorizontalFieldOfView': lens.horizontal_fov, 'VerticalFieldOfView': lens.vertical_fov,
            'MinRange': lens.min_range, 'MaxRange': lens.max_range, 'PixelsAcross': width,
            'PixelsDown': height, 'Software': f'ocp_ros {__version__}'}
