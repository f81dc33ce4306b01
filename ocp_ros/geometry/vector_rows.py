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

"""Rows of a shadow map, written several cells at a time, which no compiler does in short loops."""

from ocp_ros.util.kernels import import_elsewhere

ir, types = import_elsewhere('llvmlite.ir'), import_elsewhere('numba').types
cgutils = import_elsewhere('numba.core.cgutils')
#: Cells that are written at a time.
LANES = 8
#: Nothing here may come out as NaN.
FLAGS = ('nnan', 'nsz', 'contract', 'reassoc')


@import_elsewhere('numba.extending').intrinsic
def put_nearer(typing, cells, first, value, step, low, high, last):
    """
    Let up to ``LANES`` cells in a row hold a plane where it is nearer than what they hold.

    The memory of so many cells is read and written, and not changed beyond the last one.

    :param cells: (N,) float32, inverse distances, 1/m, in and out.
    :param first: uint64, the first cell.
    :param value: float32, the plane in it, 1/m.
    :param step: float32, how much more it is in each cell after it.
    :param low: float32, the least that it may be anywhere.
    :param high: float32, and the most.
    :param last: float32, how many cells there are after the first one.
    """
    def generate(context, builder, signature, arguments):
        cells, first, *scalars = arguments
        whole, vector = ir.IntType(32), ir.VectorType(ir.FloatType(), LANES)
        nothing = ir.Constant(vector, ir.Undefined)

        def spread(scalar):
            one = builder.insert_element(nothing, scalar, ir.Constant(whole, 0))
            return builder.shuffle_vector(
                one, nothing, ir.Constant(ir.VectorType(whole, LANES), [0] * LANES))

        def called(name, one, other):
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector, vector]),
                f'llvm.{name}.v{LANES}f32')
            return builder.call(function, [one, other], fastmath=FLAGS)

        value, step, low, high, last = map(spread, scalars)
        ramp = ir.Constant(vector, [float(lane) for lane in range(LANES)])
        value = builder.fadd(value, builder.fmul(ramp, step, flags=FLAGS), flags=FLAGS)
        value = called('maxnum', called('minnum', value, high), low)
        # 0 hides nothing; stores of some lanes alone are slow.
        value = builder.select(builder.fcmp_ordered('<=', ramp, last), value,
                               ir.Constant(vector, [0.0] * LANES))
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, cells)
        place = builder.bitcast(builder.gep(array.data, [first]), vector.as_pointer())
        nearer = called('maxnum', builder.load(place, align=4), value)
        builder.store(nearer, place, align=4)
        return context.get_dummy_value()

    return types.void(cells, first, *[types.float32] * 5), generate
