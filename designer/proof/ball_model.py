"""The error model in ball arithmetic, built link by link from the numbers of the gains file as they stand.

It shares no code with designer.model.error_model, and takes a_ij K_ij, beta(1 - beta) and A - sum of a_ij K_ij as exact
products and sums of stored floats. In mode s (docs/theory.md, section 9; it is (10)(11) of the paper where losses are
hidden and no link loses messages)

    eta+ = [A B][eta; w] + sum over l of xi_l E_l C_l [eta; w],

where the xi_l have mean 0, are uncorrelated, and are independent of eta and w: theta_j - beta_j, phi_ij - rho_ij, and
the products of both.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat, fmpq, fmpq_mat
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices, matrices_of
from designer.proof.balls import add, exact, identity, part


class Truth(NamedTuple):
    """What happens, where filters were told something else: the gains, beta_j, C_j and M in them stay as they are.

    `carry`: x is in eta, where it is in that of the file without being asked for.
    """

    beta: Array  # (n,): of arrivals
    rho: Array  # (n, n): of deliveries, from j to i
    transition: list[list[Fraction]]  # Pi; every row sums to 1
    matrices: Matrices | None = None  # None: those of the file
    carry: bool = False


def told(problem: Problem) -> Truth:
    """The probabilities of the file; rows of Pi renormalised, for they sum to 1 within the problem's tolerance only."""
    rows = [[Fraction(pi) for pi in row] for row in problem.markov.transition.tolist()]
    return Truth(problem.beta, problem.delivery, [[pi / sum(row) for pi in row] for row in rows])


Carried = list[tuple[list[int], arb_mat]]  # rows of eta+, and what leads there


class Noise(NamedTuple):
    """One xi_l: its variance, and E_l C_l by the rows of eta+ and columns of [eta; w] where they are not zero.

    `carried` (len(rows), ny_j) says what becomes of the innovation of node `sender`, or of what a `loss` takes from it.
    """

    variance: arb
    rows: list[int]
    E: arb_mat  # (len(rows), r)
    columns: list[int]
    C: arb_mat  # (r, len(columns))
    sender: int
    carried: arb_mat
    loss: bool

    @property
    def is_nothing(self) -> bool:
        """Whether it surely adds nothing: its gains are 0."""
        return is_zero(self.E) or is_zero(self.C)


class Sensor(NamedTuple):
    """What node j measures: its mean innovation bias x + C_mean e_j + D_mean w; a loss takes `lost` [eta; w] from it.

    For measurements C~_j x + D~_j w. A node that does not see its losses subtracts c_j C_j x_hat_j, where c_j is the
    beta_j that it was told.
    """

    bias: arb_mat | None  # beta_j C~_j - c_j C_j, or beta_j (C~_j - C_j) where the loss is seen; None where that is 0
    C_mean: arb_mat  # c_j C_j, or beta_j C_j where the loss is seen
    D_mean: arb_mat  # D~_j, or beta_j D~_j where the loss is seen
    beta: arb
    alpha: arb  # beta_j (1 - beta_j)
    columns: list[int]  # of `lost`
    lost: arb_mat  # C~_j over x, or [C_j, D~_j] over (e_j, w) where the loss is seen, with C~_j - C_j over x


class BallModel:
    """[A B] and the noise of every mode, M, and the chain; eta = [x; e_1; ...; e_n], or e alone where x drops out.

    With T (nx, nx) it is all of [T x; T e_1; ...; T e_n] in the end: of the same errors, whatever regular T it is.
    """

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        truth: Truth | None = None,
        T: Array | None = None,
    ) -> None:
        nx, n = problem.nx, problem.n
        self.truth = truth or told(problem)
        self.real = self.truth.matrices or matrices_of(problem)
        p = nx if problem.carries_plant or self.truth.carry else 0
        self.size, self.nw = p + n * nx, problem.nw
        self.x = list(range(p))
        self.e = [list(range(p + i * nx, p + (i + 1) * nx)) for i in range(n)]
        self.eta = list(range(self.size))
        self.w = list(range(self.size, self.size + problem.nw))
        self.M = arb_mat(n * problem.nz, self.size)
        for i in range(n):
            rows, weight = range(i * problem.nz, (i + 1) * problem.nz), arb(float(problem.weights[i]))
            add(self.M, rows, self.e[i], exact(problem.plant.M) * weight)
            if self.x:
                add(self.M, rows, self.x, (exact(self.real.M) - exact(problem.plant.M)) * weight)
        self.transition = [[arb(pi.numerator) / arb(pi.denominator) for pi in row] for row in self.truth.transition]
        self.sensors = [self._sensor(problem, j) for j in range(n)]
        self.AB: list[arb_mat] = []  # (n_eta, n_eta + nw), of every mode
        self.filled: list[NDArray[np.bool_]] = []  # where AB may be other than exactly 0
        self.noise: list[list[Noise]] = []
        self.carried: list[list[Carried]] = []  # of every mode and node j: where its mean innovation goes, and how
        for s in range(len(problem.topologies)):
            self.AB.append(arb_mat(self.size, self.size + self.nw))
            self.filled.append(np.zeros((self.size, self.size + self.nw), dtype=bool))
            self.noise.append(self._mode(problem, s, K, H))
        if T is not None:
            self._turn(T)

    def _turn(self, T: Array) -> None:
        """To T x and T e_i; `sensors` stay as they are."""
        there, back = exact(T), _inverse(T)
        self.carried = [[[(rows, there * block) for rows, block in of_j] for of_j in of_s] for of_s in self.carried]
        self.M = self._blocks(self.M, None, back)
        for s in self.modes:
            self.AB[s] = self._blocks(self.AB[s], there, back)
            self.filled[s] = np.array([not entry.is_zero() for entry in self.AB[s].entries()]).reshape(
                self.filled[s].shape
            )
            self.noise[s] = [self._turned(noise, there, back) for noise in self.noise[s]]

    def _turned(self, noise: Noise, there: arb_mat, back: arb_mat) -> Noise:
        """E is the identity where a whole message is lost, and then stays it: what T makes small is C."""
        C = noise.C * self._along(noise.columns, back)
        along = self._along(noise.rows, there)
        noise = noise._replace(carried=along * noise.carried)
        if noise.loss:
            return noise._replace(E=along * noise.E, C=C)
        return noise._replace(C=there * C)

    def _blocks(self, matrix: arb_mat, left: arb_mat | None, right: arb_mat) -> arb_mat:
        """Every block of nx columns of eta times `right`, of nx rows from the left by `left`, if there are such."""
        nx = right.nrows()
        turned, blocks = (
            arb_mat(matrix.nrows(), matrix.ncols()),
            [self.eta[k : k + nx] for k in range(0, self.size, nx)],
        )
        all_rows = [list(range(matrix.nrows()))] if left is None else blocks
        for rows in all_rows:
            for columns in [*blocks, list(range(self.size, matrix.ncols()))]:
                block = part(matrix, rows, columns)
                if columns and not is_zero(block):
                    block = block * right if columns[0] < self.size else block
                    add(turned, rows, columns, block if left is None else left * block)
        return turned

    def _along(self, places: list[int], block: arb_mat) -> arb_mat:
        """`block` for every x or e_i among these places of [eta; w], and the identity for w."""
        nx, whole = block.nrows(), identity(len(places))
        for a, i in enumerate(places):
            for b, j in enumerate(places):
                if i // nx == j // nx and max(i, j) < self.size:
                    whole[a, b] = block[i % nx, j % nx]
        return whole

    def _add(self, s: int, rows: list[int], columns: list[int], block: arb_mat) -> None:
        add(self.AB[s], rows, columns, block)
        self.filled[s][np.ix_(rows, columns)] = True

    def _sensor(self, problem: Problem, j: int) -> Sensor:
        node = problem.nodes[j]
        C, real, D = exact(node.C), exact(self.real.C[j]), exact(self.real.D[j])
        beta, c = arb(self.truth.beta[j].item()), arb(node.arrival_probability)
        by_x = (real - C) * beta if node.seen else real * beta - C * c
        if not self.x and not is_zero(by_x):
            raise ValueError(f'node "{node.name}" measures x, or loses it unseen, as its filter does not know')
        columns, lost = self.x, real
        if node.seen:
            ny, nx = C.nrows(), problem.nx
            columns, lost = self.e[j] + self.w, arb_mat(ny, nx + problem.nw)
            add(lost, range(ny), range(nx), C)
            add(lost, range(ny), range(nx, nx + problem.nw), D)
            if not is_zero(real - C):
                columns, lost = self.x + columns, _beside(real - C, lost)
        bias = None if is_zero(by_x) else by_x
        by_e, by_w = C * (beta if node.seen else c), D * beta if node.seen else D
        return Sensor(bias, by_e, by_w, beta, beta * (1 - beta), columns, lost)

    def _mode(self, problem: Problem, s: int, K: LinkMatrices, H: LinkMatrices) -> list[Noise]:
        """Fill in [A B] of mode s; its noise. K and H have the weights a_ij within from here on."""
        A, B, nx = exact(problem.plant.A), exact(self.real.B), problem.nx
        topology, names, heard = problem.topologies[s], problem.node_names, problem.neighbours
        noise, real_A = [], exact(self.real.A)
        carried: list[Carried] = [[] for _ in names]
        self.carried.append(carried)
        if self.x:
            self._add(s, self.x, self.x, real_A)
            self._add(s, self.x, self.w, B)
        for i, receiver in enumerate(names):
            weights = {j: arb(topology.adjacency[i, j].item()) for j in heard(s, i)}
            K_i = {j: exact(K[topology.name][receiver][names[j]]) * a_ij for j, a_ij in weights.items()}
            H_i = {j: exact(H[topology.name][receiver][names[j]]) * a_ij for j, a_ij in weights.items()}
            others = sum((K_i[j] for j in K_i if j != i), arb_mat(nx, nx))
            if problem.unbiased:
                K_i[i] = A - others  # what the node steps by; the file has it rounded
                if not is_zero(real_A - A):
                    self._add(s, self.e[i], self.x, real_A - A)
            elif self.x:
                self._add(s, self.e[i], self.x, real_A - others - K_i[i])
            self._add(s, self.e[i], self.w, B)
            for j in weights:
                sensor, rho = self.sensors[j], arb(self.truth.rho[i, j].item())
                by_x = None if sensor.bias is None else -(H_i[j] * sensor.bias)
                by_e, by_w = K_i[j] - H_i[j] * sensor.C_mean, -(H_i[j] * sensor.D_mean)
                if by_x is not None:
                    self._add(s, self.e[i], self.x, by_x * rho)
                self._add(s, self.e[i], self.e[j], by_e * rho)
                self._add(s, self.e[i], self.w, by_w * rho)
                carried[j].append((self.e[i], H_i[j] * -rho))
                if rho == 1:
                    continue
                self._add(s, self.e[i], self.e[i], K_i[j] * (1 - rho))
                lossy = rho * (1 - rho)
                parts = [(self.e[i], -K_i[j]), (self.e[j], by_e), (self.w, by_w), (self.x, by_x)]
                noise.append(self._of_link(i, j, lossy, parts, -H_i[j]))
                if sensor.alpha > 0:
                    taken = sensor.columns, sensor.lost
                    noise.append(Noise(lossy * sensor.alpha, self.e[i], -H_i[j], *taken, j, -H_i[j], loss=True))
        noise += [self._of_sensor(j, carried[j]) for j in range(problem.n) if self.sensors[j].alpha > 0]
        return noise

    def _of_link(
        self, i: int, j: int, variance: arb, parts: list[tuple[list[int], arb_mat | None]], carried: arb_mat
    ) -> Noise:
        """A message that arrives: K_ij (e_j - e_i) less H_ij times node j's mean innovation, in e_i."""
        nx, columns = len(self.e[i]), [at for at, block in parts if block is not None]
        C, first = arb_mat(nx, sum(map(len, columns))), 0
        for block in (block for _, block in parts if block is not None):
            add(C, range(nx), range(first, first + block.ncols()), block)
            first += block.ncols()
        return Noise(variance, self.e[i], identity(nx), [k for at in columns for k in at], C, j, carried, loss=False)

    def _of_sensor(self, j: int, carried: Carried) -> Noise:
        """A measurement that arrives: what a loss takes, in the errors of all who hear node j."""
        sensor = self.sensors[j]
        ny = sensor.lost.nrows()
        rows = [row for part_rows, _ in carried for row in part_rows]
        E = arb_mat(len(rows), ny)
        for k, (part_rows, block) in enumerate(carried):
            first = k * len(part_rows)
            add(E, range(first, first + len(part_rows)), range(ny), block)
        return Noise(sensor.alpha, rows, E, sensor.columns, sensor.lost, j, E, loss=True)

    @property
    def modes(self) -> range:
        return range(len(self.AB))

    @property
    def MM(self) -> arb_mat:
        """M'M: what |z_tilde|^2 is of eta, (n_eta, n_eta)."""
        if self.x and not is_zero(part(self.M, range(self.M.nrows()), self.x)):
            return self.M.transpose() * self.M
        MM, nz = arb_mat(self.size, self.size), self.M.nrows() // len(self.e)
        for i, e_i in enumerate(self.e):
            M_i = part(self.M, range(i * nz, (i + 1) * nz), e_i)
            add(MM, e_i, e_i, M_i.transpose() * M_i)
        return MM

    def joint(self, Y: list[arb_mat], partition: list[list[int]] | None = None) -> list[arb_mat]:
        """E|eta+|^2 weighed by Y(t), t the next mode, as a quadratic form in [eta; w], for every mode.

        [A B]'Y_bar[A B] + sum of variance (E_l C_l)'Y_bar(E_l C_l), each (n_eta + nw, n_eta + nw). `partition`: the
        blocks of every Y(t), where they are known; else it is taken as one.
        """
        return [self.weighed(s, self._bar(s, Y), partition or [self.eta]) for s in self.modes]

    def _bar(self, s: int, Y: list[arb_mat]) -> arb_mat:
        return sum((Y[t] * pi for t, pi in enumerate(self.transition[s]) if pi != 0), arb_mat(self.size, self.size))

    def weighed(self, s: int, Y_bar: arb_mat, partition: list[list[int]]) -> arb_mat:
        """The same of one mode, from Y_bar(s)."""
        S = self._mean(s, Y_bar, partition)
        for noise in self.noise[s]:
            core = noise.E.transpose() * part(Y_bar, noise.rows, noise.rows) * noise.E
            add(S, noise.columns, noise.columns, noise.C.transpose() * core * noise.C * noise.variance)
        return S

    def _mean(self, s: int, Y_bar: arb_mat, partition: list[list[int]]) -> arb_mat:
        """[A B]'Y_bar[A B], by the blocks of Y_bar: those of a P = diag{R, Q_1, ...} meet few columns of [A B] each."""
        AB = self.AB[s]
        if len(partition) == 1:
            return AB.transpose() * (Y_bar * AB)
        S = arb_mat(AB.ncols(), AB.ncols())
        for rows in partition:
            columns = np.flatnonzero(self.filled[s][rows].any(axis=0)).tolist()
            AB_rows = part(AB, rows, columns)
            add(S, columns, columns, AB_rows.transpose() * (part(Y_bar, rows, rows) * AB_rows))
        return S


def _inverse(T: Array) -> arb_mat:
    """Of floats; ZeroDivisionError where there is none."""
    rational = [[fmpq(*entry.as_integer_ratio()) for entry in row] for row in T.tolist()]
    return arb_mat(fmpq_mat(rational).inv())


def is_zero(matrix: arb_mat) -> bool:
    return all(entry.is_zero() for entry in matrix.entries())


def _beside(left: arb_mat, right: arb_mat) -> arb_mat:
    """[left right]."""
    whole, rows = arb_mat(left.nrows(), left.ncols() + right.ncols()), range(left.nrows())
    add(whole, rows, range(left.ncols()), left)
    add(whole, rows, range(left.ncols(), whole.ncols()), right)
    return whole
