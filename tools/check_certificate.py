"""Decides whether the gamma of a gains file is proved: exact integers, no solver, nothing but the standard library.

python check_certificate.py GAINS.json: proved (exit code 0), disproved, with a vector (1), or undecided (3)
Every float is the fraction that it is; digest, lower ends and words are not looked at. Equations: Zhu, Wen, Peng, Yang,
Control and Decision 35(8), 2020; sections: docs/theory.md. Vectors: [w; eta], eta = [x; e_1; ... e_n], or no x (9).
"""
import json, sys
from fractions import Fraction as Q
from math import lcm, prod
from operator import mul
SPARE, STEPS, ORDER = 100, 2000, 60  # binary places beyond those of the file; steps; the longest [w; eta] that is tried
KEYS = "name plant node arrival_probability loss weight link topology markov unbiased disturbance tolerance uncertainty"
MEAN = frozenset()  # a form is {chances: X}, the sum of all X [w; eta], each times its chances less their probabilities
unique = lambda pairs: {key: value for (key, value), _ in zip(pairs, dict(pairs), strict=True)}  # no key is there twice
zeros = lambda rows, columns: [[Q(0)] * columns for _ in range(rows)]
eye = lambda size, by=Q(1): [[by * (i == j) for j in range(size)] for i in range(size)]
turned = lambda X: [list(column) for column in zip(*X)]
scaled = lambda X, by: [[by * a for a in row] for row in X]
added = lambda *Xs: [[sum(entries) for entries in zip(*rows, strict=True)] for rows in zip(*Xs, strict=True)]
less = lambda X, Y: added(X, scaled(Y, -1))
times = lambda X, Y: [[sum(a * b for a, b in zip(row, col, strict=True) if a and b) for col in zip(*Y)] for row in X]
total = lambda *forms: {key: added(*(f[key] for f in forms if key in f)) for key in {k: 0 for f in forms for k in f}}
applied = lambda G, form: {key: times(G, X) for key, X in form.items()}
def chance(name, p, form):  # 1 with probability p, else 0, times a form: p and the deviation from it
    return {key | {(*name, p)}: X for key, X in form.items() if 0 < p < 1} | {k: scaled(X, p) for k, X in form.items()}
def model(p, K, H):  # eta one step on: uncorrelated (variance, V [w; eta]) for every mode; M'M; Pi; lengths of w and x
    (A, B, M), nodes, modes, nu = (p["plant"][letter] for letter in "ABM"), p["node"], [], []
    assert {*p, *p["plant"], *sum(map(list, nodes), [])} <= {*KEYS.split(), *"ABCDM"}, f"it says more than {KEYS}"
    names, beta, seen = zip(*((v["name"], v["arrival_probability"], v.get("loss") == "seen") for v in nodes))
    rho = {(link["receiver"], link["sender"]): link["delivery_probability"] for link in p.get("link") or ()}
    nw, nx, n, Pi = len(B[0]), len(A), len(nodes), p["markov"]["transition"]
    n_x = 0 if p.get("unbiased") and all(s or b == 1 for s, b in zip(seen, beta)) else nx
    order, off = nw + n_x + n * nx, [10**9 * abs(sum(row) - 1) for row in Pi]  # rows sum to 1, but for 1e-9
    assert order <= ORDER and all(0 <= q <= 1 for q in sum(Pi, [*beta, *rho.values(), *off])), "too large, or no chance"
    w, x = eye(order)[:nw], eye(order)[nw:][:n_x] or zeros(nx, order)  # x_hat_i = x - e_i
    x_hat, x_next = [less(x, eye(order)[k:][:nx]) for k in range(nw + n_x, order, nx)], added(times(A, x), times(B, w))
    for j, (C, D) in enumerate((v["C"], v["D"]) for v in nodes):  # node j's innovation: y less what it expects, (5)
        expected, noise, theta = scaled(times(C, x_hat[j]), -1), times(D, w), (("theta", j), beta[j])
        hidden = chance(*theta, {MEAN: times(C, x)}), {MEAN: added(noise, scaled(expected, beta[j]))}
        nu.append(chance(*theta, {MEAN: added(times(C, x), noise, expected)}) if seen[j] else total(*hidden))
    def next_error(i, a, K_i, H_i):  # x less (5) of what arrives; who misses a message takes its own estimate for it
        aK = {j: scaled(K_i[names[j]], a[j]) for j in range(n) if a[j] > 0}
        aK[i] = less(A, added(zeros(nx, nx), *(aK[j] for j in aK if j != i))) if p.get("unbiased") else aK[i]
        terms = [{MEAN: less(x_next, times(added(*aK.values()), x_hat[i]))}]
        for j in aK:
            got = total({MEAN: times(aK[j], less(x_hat[j], x_hat[i]))}, applied(scaled(H_i[names[j]], a[j]), nu[j]))
            terms.append(applied(eye(nx, -1), chance(("phi", i, j), rho.get((names[i], names[j]), Q(1)), got)))
        return total(*terms)
    for s, a in ((mode["name"], mode["adjacency"]) for mode in p["topology"]):
        parts = [{MEAN: x_next}][:n_x] + [next_error(i, a[i], K[s][me], H[s][me]) for i, me in enumerate(names)]
        V = {key: sum((part.get(key) or zeros(nx, order) for part in parts), []) for key in total(*parts)}
        modes.append([(prod(q * (1 - q) for *_, q in key), V[key]) for key in V])  # the variance of 0 or 1 is p (1 - p)
    z = [row[nw:] for v, x_i in zip(nodes, x_hat) for row in scaled(times(M, less(x, x_i)), v.get("weight", Q(1)))]
    return modes, times(turned(z), z), [[a / sum(row) for a in row] for row in Pi], nw, n_x
# From here on matrices are symmetric: their rows, each from the diagonal on, of integers in units of 1 / one.
common = lambda *Xs: lcm(*(a.denominator for X in Xs for row in X for a in row))
raised = lambda X, by: [[row[0] + by, *row[1:]] for row in X]  # by >= row sums of |E|: not below X + E; -by: not above
proved = lambda Xs: all(eliminated(X, len(X), -1)[1] is None for X in Xs)  # X > 0
blocks = lambda *Xs: [row[i:] + [0] * sum(map(len, Xs[k:])) for k, X in enumerate(Xs, 1) for i, row in enumerate(X)]
def eliminated(X, count, up):  # what is left of X, rounded up (1) or down (-1), None: all pivots were > 0; or None, v
    if not count: return X, None
    pivot, *row = X[0]
    if pivot <= 0: return None, [Q(1)] + [Q(0)] * len(row)  # v'Xv <= 0; so it was before, if rounded up since
    rest = [[a - b * c // pivot for a, c in zip(X_i, row[i:])] for i, (b, X_i) in enumerate(zip(row, X[1:]))]
    left, v = eliminated(raised(rest, up * len(row)), count - 1, up)
    return left, v and [-sum(map(mul, row, v)) / pivot, *v]
def told(what, X, unit, v):  # the exit code, by v as it is printed
    v = [Q(float(a / max(map(abs, v)))) for a in v or eye(len(X))[0]]
    at = sum(a * v[i] * v[i + j] * (2 if j else 1) for i, row in enumerate(X) for j, a in enumerate(row)) / unit
    return (1 if at <= 0 else 3), f"{what}: v'Xv = {float(at):.3g} for v = {[*map(float, v)]}"
def decide(file):  # the exit code, and in words what of the file is proved or false
    (modes, MM, Pi, nw, n_x), claim = model(file["problem"], file["K"], file["H"]), file["certificate"]
    names, nodes = ([part["name"] for part in file["problem"][kind]] for kind in ("topology", "node"))
    size, form, gamma, lyapunov = len(MM), claim["form"], claim["gamma"], claim["kind"] == "lyapunov"
    theorem1 = {gamma if lyapunov else None, claim.get("theorem1_gamma")} - {None}  # each by (17) and (18)
    stored = [[claim["P"][s]] if form == "full" else [*[claim.get("R")][:n_x], *(claim["Q"][s][i] for i in nodes)]
        for s in names if form != "summed" or theorem1]  # of every P the blocks
    gP = [blocks(*(scaled(added(X, turned(X)), gamma**2 / 2) for X in Xs)) for Xs in stored]
    numbers = [[max(t, 0) ** 2 for t in (gamma, *theorem1)]], blocks(MM), blocks(zeros(size, size)), *gP
    one, fine = common(*numbers) << SPARE, common(*(V for terms in modes for _, V in terms))
    [[g, *squares]], MM, none, *gP = ([[int(a * one) for a in row] for row in X] for X in numbers)
    one_p, one_Pi = common(*([[p] for p, _ in terms] for terms in modes)), common(Pi)
    modes = [[(int(p * one_p), [i for i, row in enumerate(V) if any(row)], [[int(a * fine) for a in v] for v in zip(
        *filter(any, V))]) for p, V in terms if any(map(any, V))] for terms in modes]  # rows that are not 0, by columns
    def over(X, Y, s, up):  # diag{g I, X} - S(Y)(s), S = E eta(k+1)'Y(t)eta(k+1), t the mode after s; S is rounded up
        left = scaled([[g] + [0] * (nw - i - 1 + size) for i in range(nw)] + X, fine**2 * one_p)
        Y_bar = added(*(scaled(Y_t, int(pi * one_Pi)) for Y_t, pi in zip(Y, Pi[s], strict=True)))
        Y_bar = raised([[a // one_Pi for a in row] for row in Y_bar], up * size)
        for p, rows, V in modes[s]:
            Y_here = [[Y_bar[min(i, j)][abs(i - j)] for j in rows] for i in rows]
            YV = [[sum(map(mul, row, v)) for row in Y_here] for v in V]
            left = [[a - p * sum(map(mul, u, v)) for a, v in zip(r, V[c:])] for c, (r, u) in enumerate(zip(left, YV))]
        return raised([[a // (fine**2 * one_p) for a in row] for row in left], -up * (nw + size))
    def backwards(X, U, up, done):  # section 2 from X on, rounded, plus U at every step: Y where it is done; or why not
        Y = [X] * len(modes)
        for k in range(1, STEPS):
            left = [eliminated(over(none, Y, s, up), nw, -up) for s in range(len(modes))]
            for s, (_, v) in enumerate(left):
                if v: return None, told(f"W > 0 in mode {names[s]} at step {k}", over(none, Y, s, up), one, v)
            F = [scaled(rest, -1) for rest, _ in left]
            if k % (1 << k.bit_length() // 2) == 0 and done(Y, F): return Y, None
            Y = [added(F_s, U) for F_s in F]
        return None, (3, f"the recursion does not end in {STEPS} steps")
    for k, (s, X) in enumerate(zip(names, gP)):
        both = [("(18)", left, left, g * t) for t in squares for left in [less(scaled(X, t), scaled(MM, g))]]
        for what, low, high, unit in [("(17)", over(X, gP, k, 1), over(X, gP, k, -1), g), *both]:
            if not proved([low]): return told(f"{what} in mode {s}", high, unit, eliminated(high, len(high), 1)[1])
    units = (blocks(eye(size, g >> bits)) for bits in range(12, 100, 12))
    gP = gP or next(filter(None, (backwards(U, U, 1, lambda Y, F: proved(map(less, Y, F)))[0] for U in units)), [])
    good = lyapunov or (gP and backwards(MM, none, 1, lambda Y, _: proved(map(less, gP, Y)))[0])
    return (0, f"gamma = {float(claim['gamma'])}") if good else backwards(MM, none, -1, lambda *_: False)[1]
if __name__ == "__main__":
    try:
        with open(sys.argv[1]) as gains:
            number = dict.fromkeys(("parse_float", "parse_int", "parse_constant"), lambda text: Q(float(text)))
            code, words = decide(json.load(gains, object_pairs_hook=unique, **number))
    except (ArithmeticError, AssertionError, LookupError, OSError, TypeError, ValueError) as error:
        code, words = 3, f"{type(error).__name__}: {error}"
    print({0: "proved", 1: "disproved", 3: "undecided"}[code] + f": {words}")
    sys.exit(code)
