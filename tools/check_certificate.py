"""Decides whether the gamma of a gains file is proved: exact fractions, no solver, nothing but the standard library.

python check_certificate.py GAINS.json: proved (exit code 0), disproved, with a vector (1), or undecided (3)
Every float is the fraction that it is; digest, lower ends and words are not looked at. Equations are those of Zhu, Wen,
Peng, Yang, Control and Decision 35(8), 2020; sections those of docs/theory.md, which derives all that is used here.
Vectors are [w; eta], eta = [x; e_1; ...; e_n]; without x where gains are unbiased and no loss is hidden (section 9).
"""
import json, sys
from fractions import Fraction as Q
from math import lcm, prod
BITS, STEPS, ORDER = 96, 2000, 50  # of a rounded number; of a recursion; the longest [w; eta] that is tried
KEYS = "name plant node arrival_probability loss weight link topology markov unbiased disturbance tolerance uncertainty"
MEAN = frozenset()  # a form is {chances: X}, the sum of all X [w; eta], each times its chances less their probabilities
zeros = lambda rows, columns: [[Q(0)] * columns for _ in range(rows)]
eye = lambda size, by=Q(1): [[by * (i == j) for j in range(size)] for i in range(size)]
turned = lambda X: [list(column) for column in zip(*X)]
scaled = lambda X, by: [[by * a for a in row] for row in X]
added = lambda *Xs: [[sum(entries) for entries in zip(*rows, strict=True)] for rows in zip(*Xs, strict=True)]
less = lambda X, Y: added(X, scaled(Y, -1))
total = lambda *forms: {key: added(*(f[key] for f in forms if key in f)) for key in {k: 0 for f in forms for k in f}}
applied = lambda G, form: {key: times(G, X) for key, X in form.items()}
above = lambda Xs, Ys: all(eliminated(X, len(X))[1] is None for X in map(less, Xs, Ys))  # as matrices, each pair
def blocks(*Xs):  # square ones, along the diagonal
    before = [sum(map(len, Xs[:k])) for k in range(len(Xs) + 1)]
    return [[Q(0)] * b + row + [Q(0)] * (before[-1] - b - len(X)) for b, X in zip(before, Xs) for row in X]
def times(X, Y):  # as integers over common denominators
    c, d = (lcm(*(a.denominator for row in Z for a in row)) for Z in (X, Y))
    columns, rows = turned([[int(a * d) for a in row] for row in Y]), [[int(a * c) for a in row] for row in X]
    return [[Q(sum(a * b for a, b in zip(row, col, strict=True) if a), c * d) for col in columns] for row in rows]
def chance(name, p, form):  # 1 with probability p, else 0, times a form: p and the deviation from it
    more = {key | {(*name, p)}: X for key, X in form.items() if 0 < p < 1}
    return more | {key: scaled(X, p) for key, X in form.items()}
def model(p, K, H):  # eta one step on: uncorrelated (variance, V [w; eta]) for every mode; M'M; Pi; lengths of w and x
    (A, B, M), nodes, modes, nu = (p["plant"][letter] for letter in "ABM"), p["node"], [], []
    assert {*p, *p["plant"], *sum(map(list, nodes), [])} <= {*KEYS.split(), *"ABCDM"}, f"it says more than {KEYS}"
    names, beta, seen = zip(*((v["name"], v["arrival_probability"], v.get("loss") == "seen") for v in nodes))
    rho = {(link["receiver"], link["sender"]): link["delivery_probability"] for link in p.get("link") or ()}
    nw, nx, n = len(B[0]), len(A), len(nodes)
    n_x = 0 if p.get("unbiased") and all(s or b == 1 for s, b in zip(seen, beta)) else nx
    order, Pi = nw + n_x + n * nx, p["markov"]["transition"]
    assert order <= ORDER and all(0 <= q <= 1 for q in sum(Pi, [*beta, *rho.values()])), "too large, or no probability"
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
def eliminated(X, count):  # what is left of symmetric X, None: all pivots were > 0; or None, v with v'Xv <= 0, v not 0
    if not count: return X, None
    pivot, *row = X[0]
    if pivot <= 0: return None, [Q(1)] + [Q(0)] * len(row)
    rest = [[a - r[0] * b / pivot for a, b in zip(r[1:], row)] if r[0] else r[1:] for r in X[1:]]
    left, v = eliminated(rest, count - 1)
    return left, v and [-sum(a * b for a, b in zip(row, v)) / pivot, *v]
def rounded(Y, up):  # short fractions; as a matrix not below Y (up = 1), or not above (-1): row sums of what is lost
    grid = [Q(2) ** ((row[i].numerator.bit_length() - row[i].denominator.bit_length()) // 2) for i, row in enumerate(Y)]
    Z = [[Q(round(a / (c * d) * 2**BITS), 2**BITS) * c * d for a, d in zip(row, grid)] for row, c in zip(Y, grid)]
    return added(Z, blocks(*([[up * c**2 * Q(len(Y), 2**BITS) * any(row)]] for c, row in zip(grid, Y))))
def decide(file):  # the exit code, and in words what of the file is proved or false
    (modes, MM, Pi, nw, n_x), claim = model(file["problem"], file["K"], file["H"]), file["certificate"]
    names, nodes = ([part["name"] for part in file["problem"][kind]] for kind in ("topology", "node"))
    every, size, g, form = range(len(modes)), len(MM), claim["gamma"] ** 2, claim["form"]
    def S(Y, s):  # E eta(k+1)'Y(t)eta(k+1), t the mode after s, as a quadratic form in [w; eta]
        Y_bar = added(*(scaled(Y_t, pi) for Y_t, pi in zip(Y, Pi[s], strict=True)))
        return added(*(scaled(times(turned(V), times(Y_bar, V)), variance) for variance, V in modes[s]))
    def backwards(Y, U, up, done):  # section 2, rounded, U added at every step: True, Y where it is done; False, why
        for k in range(1, STEPS):
            W = [less(blocks(eye(nw, g), zeros(size, size)), rounded(S(Y, s), up)) for s in every]
            left = [eliminated(W_s, nw) for W_s in W]
            for s in (s for s in every if left[s][1]):
                return False, (f"W > 0 at step {k}", s, [row[:nw] for row in W[s][:nw]], left[s][1][:nw])
            F = [rounded(scaled(rest, -1), up) for rest, _ in left]
            if k % (1 + k // 8) == 0 and done(Y, F): return True, Y
            Y = [added(F_s, U) for F_s in F]
        return None, f"the recursion does not end in {STEPS} steps"
    def summed(k):  # where P is not stored: Y / g for a Y that is above what a step makes of it
        U = eye(size, g / 64**k)
        holds, Y = backwards([U] * len(modes), U, 1, above)
        return [scaled(Y_s, 1 / g) for Y_s in Y] if holds else None
    def stored(s):
        P_s = claim["P"][s] if form == "full" else blocks(*[claim.get("R")][:n_x], *(claim["Q"][s][i] for i in nodes))
        return scaled(added(P_s, turned(P_s)), Q(1, 2))
    P = next(filter(None, map(summed, range(20))), []) if form == "summed" else [*map(stored, names)]
    checks = [("(17)", s, less(blocks(eye(nw), P_s), S(P, s))) for s, P_s in enumerate(P)]
    for gamma in {claim["gamma"] if claim["kind"] == "lyapunov" else None, claim.get("theorem1_gamma")} - {None}:
        checks += [("(18)", s, less(P_s, scaled(MM, 1 / gamma**2))) for s, P_s in enumerate(P)]
    false = [(what, s, X, v) for what, s, X in checks if (v := eliminated(X, len(X))[1])]
    def told(what, s, X, v):
        v = [Q(float(a / max(map(abs, v)))) for a in v]  # as it is printed
        at = times(times([v], X), turned([v]))[0][0]
        return (1 if at <= 0 else 3), f"{what} in mode {names[s]}: v'Xv = {float(at):.3g} for v = {[*map(float, v)]}"
    if false and form != "summed": return told(*false[0])  # of a P that is not in the file nobody claims anything
    start, none, gP = [MM] * len(modes), zeros(size, size), [scaled(P_s, g) for P_s in P]
    if P and not false and (claim["kind"] == "lyapunov" or backwards(start, none, 1, lambda Y, _: above(gP, Y))[0]):
        return 0, f"gamma = {float(claim['gamma'])}"
    holds, why = backwards(start, none, -1, lambda *_: False)
    return told(*why) if holds is False else (3, why)
if __name__ == "__main__":
    try:
        with open(sys.argv[1]) as gains:
            number = dict.fromkeys(("parse_float", "parse_int", "parse_constant"), lambda text: Q(float(text)))
            code, words = decide(json.load(gains, **number))
    except (ArithmeticError, AssertionError, LookupError, OSError, TypeError, ValueError) as error:
        code, words = 3, f"{type(error).__name__}: {error}"
    print({0: "proved", 1: "disproved", 3: "undecided"}[code] + f": {words}")
    sys.exit(code)
