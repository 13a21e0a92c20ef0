"""The scheme of the benchmark in Taichi, with its automatic differentiation.

As differentiable programs are written there: the state of every step is a field; the backward pass
makes each step once more and then runs its kernels' adjoints in reverse order.
"""

import itertools

import mpm_scenes
import taichi as ti

MASS_FLOOR = 1e-10


def forward(scene: mpm_scenes.Scene):
    body = _Body(scene)

    def call():
        body.run()
        return float(body.loss[None])

    call()  # compiles
    return call, body.memory


def gradient(scene: mpm_scenes.Scene):
    body = _Body(scene)

    def call():
        body.run()
        body.back()
        return float(body.mu.grad[None])

    call()
    return call, body.memory


@ti.data_oriented
class _Body:
    def __init__(self, scene: mpm_scenes.Scene):
        ti.init(arch=ti.cpu, cpu_max_num_threads=1, offline_cache=False, log_level=ti.ERROR)
        axes = scene.x.shape[1]
        self.axes, self.steps, self.count = axes, scene.steps, scene.count
        self.nodes, self.dt, self.spacing = scene.nodes, scene.dt, 1 / scene.nodes
        self.corotated = scene.law == "corotated"
        shape = scene.steps + 1, scene.count
        self.x, self.v = (ti.Vector.field(axes, ti.f32, shape, needs_grad=True) for _ in range(2))
        self.C, self.F = (
            ti.Matrix.field(axes, axes, ti.f32, shape, needs_grad=True) for _ in range(2)
        )
        grid = (scene.nodes,) * axes
        self.momentum = ti.Vector.field(axes, ti.f32, grid, needs_grad=True)
        self.out = ti.Vector.field(axes, ti.f32, grid, needs_grad=True)
        self.mass = ti.field(ti.f32, grid, needs_grad=True)
        self.mu, self.loss = (ti.field(ti.f32, (), needs_grad=True) for _ in range(2))
        self.mu[None] = mpm_scenes.MU
        self.offsets = list(itertools.product(range(3), repeat=axes))
        self.memory = 2 * scene.state_bytes * (scene.steps + 1) / 1e6
        self.start(scene.x, scene.v)

    @ti.kernel
    def start(self, x: ti.types.ndarray(), v: ti.types.ndarray()):
        for p in range(self.count):
            for i in ti.static(range(self.axes)):
                self.x[0, p][i] = x[p, i]
                self.v[0, p][i] = v[p, i]
            self.F[0, p] = ti.Matrix.identity(ti.f32, self.axes)
            self.C[0, p] = ti.Matrix.zero(ti.f32, self.axes, self.axes)

    @ti.kernel
    def clear(self):
        for node in ti.grouped(self.mass):
            self.mass[node] = 0
            self.mass.grad[node] = 0
            self.momentum[node] = ti.Vector.zero(ti.f32, self.axes)
            self.momentum.grad[node] = ti.Vector.zero(ti.f32, self.axes)
            self.out.grad[node] = ti.Vector.zero(ti.f32, self.axes)

    @ti.func
    def stress(self, F):
        identity = ti.Matrix.identity(ti.f32, self.axes)
        result = identity
        if ti.static(self.corotated):
            J = F.determinant()
            R, S = ti.polar_decompose(F)
            shear = 2 * self.mu[None] * (F - R) @ F.transpose()
            result = shear + mpm_scenes.LAM * (J - 1) * J * identity
        else:
            pressure = mpm_scenes.LAM * ti.log(F.determinant()) - self.mu[None]
            result = self.mu[None] * F @ F.transpose() + pressure * identity
        return result

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(self.count):
            base = ti.cast(self.x[s, p] / self.spacing - 0.5, ti.i32)
            fx = self.x[s, p] / self.spacing - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            F = (ti.Matrix.identity(ti.f32, self.axes) + self.dt * self.C[s, p]) @ self.F[s, p]
            self.F[s + 1, p] = F
            factor = -self.dt * mpm_scenes.VOLUME * 4 / self.spacing**2
            affine = factor * self.stress(F) + mpm_scenes.MASS * self.C[s, p]
            for k in ti.static(range(3**self.axes)):
                offset = ti.Vector(self.offsets[k])
                away = (ti.cast(offset, ti.f32) - fx) * self.spacing
                weight = 1.0
                for i in ti.static(range(self.axes)):
                    weight *= w[self.offsets[k][i]][i]
                self.momentum[base + offset] += weight * (
                    mpm_scenes.MASS * self.v[s, p] + affine @ away
                )
                self.mass[base + offset] += weight * mpm_scenes.MASS

    @ti.kernel
    def advance(self):
        for node in ti.grouped(self.mass):
            v = self.momentum[node] / (self.mass[node] + MASS_FLOOR)
            v[self.axes - 1] -= self.dt * mpm_scenes.GRAVITY
            for i in ti.static(range(self.axes)):
                if node[i] < mpm_scenes.WALLS and v[i] < 0:
                    v[i] = 0
                if node[i] > self.nodes - mpm_scenes.WALLS and v[i] > 0:
                    v[i] = 0
            self.out[node] = v

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(self.count):
            base = ti.cast(self.x[s, p] / self.spacing - 0.5, ti.i32)
            fx = self.x[s, p] / self.spacing - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, self.axes)
            C = ti.Matrix.zero(ti.f32, self.axes, self.axes)
            for k in ti.static(range(3**self.axes)):
                offset = ti.Vector(self.offsets[k])
                away = ti.cast(offset, ti.f32) - fx
                weight = 1.0
                for i in ti.static(range(self.axes)):
                    weight *= w[self.offsets[k][i]][i]
                node = self.out[base + offset]
                v += weight * node
                C += 4 / self.spacing * weight * node.outer_product(away)
            self.v[s + 1, p] = v
            self.C[s + 1, p] = C
            self.x[s + 1, p] = self.x[s, p] + self.dt * v

    @ti.kernel
    def measure(self):
        for p in range(self.count):
            for i in ti.static(range(self.axes)):
                self.loss[None] += self.x[self.steps, p][i] ** 2 / (self.count * self.axes)

    def run(self):
        for s in range(self.steps):
            self.clear()
            self.p2g(s)
            self.advance()
            self.g2p(s)
        self.loss[None] = 0
        self.measure()

    def back(self):
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
