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

"""Write rows of a shadow map several cells at a time; compilers do not vectorise short loops."""

from ocp_ros.util.kernels import import_elsewhere

ir, types = import_elsewhere('llvmlite.ir'), import_elsewhere('numba').types
cgutils = import_elsewhere('numba.core.cgutils')
#: The number of cells that are written at once.
LANES = 8
#: LLVM's fast-math flags: no value here becomes NaN.
FASTMATH = ('nnan', 'nsz', 'contract', 'reassoc')


@import_elsewhere('numba.extending').intrinsic
def put_nearer(typing, cells, first, value, step, low, high, last):
    """
    Generate code that writes a plane into up to ``LANES`` cells of a row, where it is nearer.

    The memory of ``LANES`` cells is read and written; cells after the last one do not change.

    :param cells: (N,) float32, inverse distances, 1/m, in and out.
    :param first: uint64, the index of the first cell.
    :param value: float32, the inverse distance of the plane in the first cell, 1/m.
    :param step: float32, the increase of the inverse distance per cell, 1/m.
    :param low: float32, the lower limit of the written values, 1/m.
    :param high: float32, the upper limit of the written values, 1/m.
    :param last: float32, the number of cells after the first one.
    :returns: the signature and the code generator, for Numba. This function gets the types of the
        arguments, and ``generate`` their LLVM values.
    """
    def generate(context, builder, signature, arguments):
        cells, first, *scalars = arguments
        integer, vector = ir.IntType(32), ir.VectorType(ir.FloatType(), LANES)
        undefined = ir.Constant(vector, ir.Undefined)

        def repeat_in_lanes(scalar):
            first_lane = builder.insert_element(undefined, scalar, ir.Constant(integer, 0))
            return builder.shuffle_vector(
                first_lane, undefined, ir.Constant(ir.VectorType(integer, LANES), [0] * LANES))

        def call_intrinsic(name, left, right):
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector, vector]),
                f'llvm.{name}.v{LANES}f32')
            return builder.call(function, [left, right], fastmath=FASTMATH)

        value, step, low, high, last = map(repeat_in_lanes, scalars)
        ramp = ir.Constant(vector, [float(lane) for lane in range(LANES)])
        value = builder.fadd(value, builder.fmul(ramp, step, flags=FASTMATH), flags=FASTMATH)
        value = call_intrinsic('maxnum', call_intrinsic('minnum', value, high), low)
        # Lanes after the last cell get 0, which is infinitely far away, so that the maximum below
        # does not change their cells; storing only some lanes would be slow.
        value = builder.select(builder.fcmp_ordered('<=', ramp, last), value,
                               ir.Constant(vector, [0.0] * LANES))
        # The alignment is that of one cell, 4 bytes: a row may begin anywhere.
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, cells)
        pointer = builder.bitcast(builder.gep(array.data, [first]), vector.as_pointer())
        nearer = call_intrinsic('maxnum', builder.load(pointer, align=4), value)
        builder.store(nearer, pointer, align=4)
        return context.get_dummy_value()

    return types.void(cells, first, *[types.float32] * 5), generate
