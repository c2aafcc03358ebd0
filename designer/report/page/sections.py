"""The sections of the page that are no charts: verdict, proofs, ladder, nodes, and where it comes from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np

from agent.contract.errors import counted
from designer.ladder import rounded_up, rung_text
from designer.report.account import THIS_RUN, Account
from designer.report.page import words
from designer.report.scales import brief

ROWS = 12  # of the nodes' table that stand open
NAMED = 8  # faults of a kind that are named
MARKS = {"agrees": "✓", "agrees for what is there": "◐", "diverges": "✗", "unreadable": "?"}
VERSIONS = ("peakmesh", "python", "numpy", "eclipse-zenoh", "pydantic", "mcap")
NODE_HEADS = (
    "node", "root mean square", "largest", "at step", "measurements lost", "by the model", "messages not used",
    "its exact gain", "in white noise",
)  # fmt: skip


def head(account: Account) -> str:
    """What was run, the verdict on it, and the numbers that count."""
    verdict, problem = account.verdict, account.log.gains.problem
    sentence = escape(words.verdict_sentence(verdict))
    tiles = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for value, what in _tiles(account))
    return (
        f'<p class="kicker">peakmesh, report of a run</p><h1>{escape(problem.name)}'
        f"<small>run {escape(verdict.run)}, seed {verdict.seed}</small></h1>"
        f'<section class="verdict {verdict.outcome.replace(" ", "-")}" aria-label="Verdict">'
        f'<span aria-hidden="true">{MARKS[verdict.outcome]}</span><p><b>{sentence}</b></p>'
        f'<p>{escape(words.error_sentence(account))}</p></section><dl class="tiles">{tiles}</dl>'
    )


def _tiles(account: Account) -> Iterator[tuple[str, str]]:
    verdict, n = account.verdict, account.log.gains.problem.n
    yield words.grouped(verdict.steps), f"of {words.grouped(verdict.planned)} steps"
    yield words.grouped(verdict.messages), "messages"
    yield str(n), "nodes" if n > 1 else "node"
    if verdict.peak and account.log.has_plant:
        yield brief(verdict.peak.size, 3), f"largest error |z̃|, at step {verdict.peak.step}"
    if verdict.gamma.failure is None:
        yield rounded_up(verdict.gamma.value), "γ, proved"
    if verdict.path_margin is not None:
        yield f"{verdict.path_margin:.1%}", "least distance to this run's own bound"


def proofs(account: Account) -> str:
    """The table of the five proofs, and what replay found wrong."""
    rows = []
    for proof in account.verdict.proofs:
        claim, why = words.PROOFS[proof.number]
        outcome, mark = words.proof_outcome(proof)
        rows.append(
            f'<tr class="{outcome.split()[0]}"><td>{proof.number}</td><th scope="row">{claim}<small>{why}</small></th>'
            f'<td class="outcome"><span aria-hidden="true">{mark}</span> {outcome}</td>'
            f"<td>{escape(words.proof_details(proof, account.verdict.tolerance))}</td></tr>"
        )
    heads = _heads(("No.", "What was held against the recording", "Outcome", "Looked at"))
    faults = "".join(f"<li>{escape(fault)}</li>" for fault in _faults(account))
    table = f'<table class="proofs">{heads}<tbody>{"".join(rows)}</tbody></table>'
    below = f'<ul class="faults">{faults}</ul>' if faults else ""
    return f'<section id="proofs"><h2>Five proofs</h2><div class="wide">{table}</div>{below}</section>'


def _heads(names: tuple[str, ...]) -> str:
    cells = "".join(f'<th scope="col">{name}</th>' for name in names)
    return f"<thead><tr>{cells}</tr></thead>"


def _faults(account: Account) -> Iterator[str]:
    verdict = account.verdict
    if verdict.damage:
        yield f"The file: {verdict.damage}."
    for gap in verdict.gaps:
        yield f"Not in this file: {gap}."
    for word, faults in (("Missing", verdict.missing), ("Double", verdict.duplicates)):
        if faults.total:
            first = ", ".join(f"{place.topic} step {place.step}" for place in faults.first[:NAMED])
            yield f"{word}: {counted(faults.total, 'message')}; first {first}."
    for fault in (*verdict.strange, *verdict.numbering, *verdict.evidence.wrong)[:NAMED]:
        yield f"{fault}."
    if verdict.ledger and not verdict.ledger.is_plain:
        yield f"What γ says of this run: {verdict.ledger.text()}."
    for note in verdict.notes:
        yield f"Note: {note}."
    if verdict.external:
        yield f"Real sensors: {', '.join(verdict.external)}. Estimates are compared in place of errors."


def ladder(account: Account) -> str:
    """Every rung as a bar; with them, what this run came to. Nothing where there is neither."""
    if not account.rungs:
        return ""
    highest = max((value for _, value in account.rungs), default=0.0) or 1.0
    rows = "".join(
        f'<tr{" class=own" * (name == THIS_RUN)}><th scope="row">{escape(name)}</th><td class="bar">'
        f'<i style="width:{100 * value / highest:.1f}%"></i></td><td>{escape(rung_text(name, value))}</td></tr>'
        for name, value in account.rungs
    )
    about = "The largest error per root of the disturbance's energy, in the mean over many runs. "
    about += "No filter of this kind gets below the floor; γ is what is proved of these gains."
    if all(name == THIS_RUN for name, _ in account.rungs):
        about = "Nothing is claimed of these gains; there is only what this run came to."
    return (
        f'<section id="ladder"><h2>What these gains are worth</h2><p>{about}</p>'
        f'<table class="ladder"><tbody>{rows}</tbody></table></section>'
    )


def nodes(account: Account) -> str:
    """A row for each node, that with the largest error first."""
    rows = list(_node_rows(account))
    body = f"{_heads(NODE_HEADS)}<tbody>{''.join(rows)}</tbody>"
    table = f'<div class="wide"><table class="numbers">{body}</table></div>'
    if len(rows) > ROWS:
        table = f"<details><summary>All {len(rows)} nodes</summary>{table}</details>"
    what = "|z − ẑ|" if account.log.has_plant else "the distance from the median of all nodes"
    about = (
        f"<p>Of {what}, the largest root mean square first. By the model, computed: the exact gain to each node's own "
    )
    about += "error, and its root mean square in the steady state under white w of unit covariance.</p>"
    return f'<section id="nodes"><h2>The nodes</h2>{about}{table}</section>'


def _node_rows(account: Account) -> Iterator[str]:
    noise, gains = account.beyond.noise, account.beyond.gains
    for i in account.ranking:
        node, lost = account.log.gains.problem.nodes[i], account.lost[:, i]
        sizes = np.nan_to_num(account.sizes[:, i])
        cells = [
            brief(float(account.rms[i]), 3),
            brief(float(sizes.max()), 3),
            str(int(sizes.argmax())),
            f"{np.nanmean(lost):.1%}" if np.isfinite(lost).any() else "not known",
            f"{1.0 - node.arrival_probability:.1%}",
            f"{np.nansum(account.done_without[:, i]):.0f}",
            "–" if gains is None else brief(gains[i][1], 3),
            "–" if noise is None else brief(float(noise.nodes[i]) ** 0.5, 3),
        ]
        yield f'<tr><th scope="row">{escape(node.name)}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'


def provenance(account: Account) -> str:
    """What it takes to check all of this, or to run it again."""
    log, run = account.log, account.log.run
    again = f"peakmesh run gains.json --steps {log.planned} --seed {log.seed}"
    if log.is_paced:
        again = "not possible: the clock decided what came in time"
    facts = [
        *((f"recording {path.name}", f"SHA-256 {_sha256(path)}") for path in account.paths if path.is_file()),
        ("run", run.get("run", "")),
        ("started", run.get("started", "")),
        ("seed", str(log.seed)),
        ("problem", f"{log.gains.problem.name}, digest {log.gains.problem_digest}"),
        ("gains", f"method {log.gains.method}, digest {log.gains.digest()}"),
        ("certificate", account.verdict.gamma.text().removeprefix("certificate").strip()),
        ("made with", ", ".join(f"{name} {run[name]}" for name in VERSIONS if name in run)),
        ("the same run again", "not possible: real sensors took part" if any(log.external) else again),
        ("the verdict again", f"peakmesh replay {' '.join(path.name for path in account.paths)}"),
    ]
    rows = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in facts if text)
    attached = "<p>gains.json is attached to the recording.</p>"
    return f'<section id="provenance"><h2>Where this comes from</h2><dl>{rows}</dl>{attached}</section>'


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
