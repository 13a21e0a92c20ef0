"""The block of `_points` in Taichi, with its automatic differentiation.

As differentiable programs are written there: the state of every step is a field; the backward pass
makes each step once more and then runs its kernels' adjoints in reverse order.
"""

import itertools

import _points
import taichi as ti  # pyright: ignore[reportMissingImports]

SPACING, MASS_FLOOR = 1 / _points.NODES, 1e-10
OFFSETS = list(itertools.product(range(3), repeat=2))


@ti.data_oriented
class Block:
    """The block; `run` and `run_back` give the loss and its derivative by mu. `memory` [MB]."""

    def __init__(self, steps: int):
        ti.init(arch=ti.cpu, cpu_max_num_threads=1, offline_cache=False, log_level=ti.ERROR)
        self.steps, shape = steps, (steps + 1, _points.COUNT)
        self.x, self.v = (ti.Vector.field(2, ti.f32, shape, needs_grad=True) for _ in range(2))
        self.C, self.F = (ti.Matrix.field(2, 2, ti.f32, shape, needs_grad=True) for _ in range(2))
        grid = (_points.NODES, _points.NODES)
        self.momentum = ti.Vector.field(2, ti.f32, grid, needs_grad=True)
        self.out = ti.Vector.field(2, ti.f32, grid, needs_grad=True)
        self.mass = ti.field(ti.f32, grid, needs_grad=True)
        self.mu, self.loss = (ti.field(ti.f32, (), needs_grad=True) for _ in range(2))
        self.mu[None] = _points.MU
        self.memory = 2 * 4 * 12 * _points.COUNT * (steps + 1) / 1e6
        self.start(*_points.start_of_block())

    @ti.kernel
    def start(self, x: ti.types.ndarray(), v: ti.types.ndarray()):
        for p in range(_points.COUNT):
            self.x[0, p] = ti.Vector([x[p, 0], x[p, 1]])
            self.v[0, p] = ti.Vector([v[p, 0], v[p, 1]])
            self.F[0, p] = ti.Matrix.identity(ti.f32, 2)

    @ti.kernel
    def clear(self):
        for node in ti.grouped(self.mass):
            self.mass[node] = 0
            self.mass.grad[node] = 0
            self.momentum[node] = ti.Vector.zero(ti.f32, 2)
            self.momentum.grad[node] = ti.Vector.zero(ti.f32, 2)
            self.out.grad[node] = ti.Vector.zero(ti.f32, 2)

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(_points.COUNT):
            base = ti.cast(self.x[s, p] / SPACING - 0.5, ti.i32)
            fx = self.x[s, p] / SPACING - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            identity = ti.Matrix.identity(ti.f32, 2)
            F = (identity + _points.DT * self.C[s, p]) @ self.F[s, p]
            self.F[s + 1, p] = F
            pressure = _points.LAMBDA * ti.log(F.determinant()) - self.mu[None]
            stress = self.mu[None] * F @ F.transpose() + pressure * identity
            factor = -_points.DT * _points.VOLUME * 4 / SPACING**2
            affine = factor * stress + _points.MASS * self.C[s, p]
            for k in ti.static(range(9)):
                offset = ti.Vector(OFFSETS[k])
                away = (ti.cast(offset, ti.f32) - fx) * SPACING
                weight = w[OFFSETS[k][0]][0] * w[OFFSETS[k][1]][1]
                self.momentum[base + offset] += weight * (
                    _points.MASS * self.v[s, p] + affine @ away
                )
                self.mass[base + offset] += weight * _points.MASS

    @ti.kernel
    def advance(self):
        for node in ti.grouped(self.mass):
            v = self.momentum[node] / (self.mass[node] + MASS_FLOOR)
            v[1] -= _points.DT * _points.GRAVITY
            for i in ti.static(range(2)):
                if node[i] < _points.WALLS and v[i] < 0:
                    v[i] = 0
                if node[i] > _points.NODES - _points.WALLS and v[i] > 0:
                    v[i] = 0
            self.out[node] = v

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(_points.COUNT):
            base = ti.cast(self.x[s, p] / SPACING - 0.5, ti.i32)
            fx = self.x[s, p] / SPACING - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, 2)
            C = ti.Matrix.zero(ti.f32, 2, 2)
            for k in ti.static(range(9)):
                offset = ti.Vector(OFFSETS[k])
                weight = w[OFFSETS[k][0]][0] * w[OFFSETS[k][1]][1]
                node = self.out[base + offset]
                v += weight * node
                C += 4 / SPACING * weight * node.outer_product(ti.cast(offset, ti.f32) - fx)
            self.v[s + 1, p] = v
            self.C[s + 1, p] = C
            self.x[s + 1, p] = self.x[s, p] + _points.DT * v

    @ti.kernel
    def measure(self):
        for p in range(_points.COUNT):
            self.loss[None] += self.x[self.steps, p].norm_sqr() / (2 * _points.COUNT)

    def run(self) -> float:
        for s in range(self.steps):
            self.clear()
            self.p2g(s)
            self.advance()
            self.g2p(s)
        self.loss[None] = 0
        self.measure()
        return float(self.loss[None])

    def run_back(self) -> float:
        self.run()
        for field in (self.x, self.v, self.C, self.F, self.mu):
            field.grad.fill(0)
        self.loss.grad[None] = 1
        self.measure.grad()
        for s in reversed(range(self.steps)):
            self.clear()
            self.p2g(s)
            self.advance()
            self.g2p.grad(s)
            self.advance.grad()
            self.p2g.grad(s)
        return float(self.mu.grad[None])
