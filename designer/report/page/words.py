"""What a report says in words, for whoever was not there and need not know the mathematics."""

from __future__ import annotations

from agent.contract.errors import counted
from designer.replay.verdict import CLAIMS, Divergence, Proof, Verdict
from designer.report.account import Account
from designer.report.scales import brief

PROOFS = {  # what each proof of a replay shows, in plain words
    1: (
        "The inputs are genuine",
        "Topologies, losses and disturbance are those that the seed gives, plant and sensors obey their equations, and "
        "what every node says of itself is so.",
    ),
    2: (
        "Every step follows from the one before",
        "From what was recorded at a step, the model of the whole network gives what was recorded at the next.",
    ),
    3: (
        "The whole run follows from its beginning",
        "The model of the whole network, left to itself from the first step on, stays with the recording.",
    ),
    4: ("Nothing is missing, nothing is there twice", "Every sender's messages are there, each once."),
    5: (
        "The errors kept their bound",
        "At no step were they larger than a disturbance of this size can make them, with this run's topologies and "
        "losses.",
    ),
}


def verdict_sentence(verdict: Verdict) -> str:
    """Whether the recording can be believed."""
    match verdict.outcome:
        case "diverges":
            return f"This recording is not a true account of the run: {_what_is_wrong(verdict)}."
        case "unreadable" if verdict.agrees:
            return "Of this recording nothing can be said: it holds nothing that could be computed again."
        case "unreadable":
            return "Of this recording nothing can be said: its bytes were changed after it was written."
    but = ", but for what the real sensors measured," if verdict.external else ""
    follows = (
        f"every number in it{but} was computed again, independently of the nodes, and is what this network must give, "
        "to within rounding"
    )
    if verdict.outcome == "agrees":
        return f"This recording can be believed: no message is missing, and {follows}."
    return f"As far as it goes this recording can be believed: {follows}. But it is not whole: {_what_lacks(verdict)}."


def _what_lacks(verdict: Verdict) -> str:
    """In a few words: how far the run goes, what the file has not of it, and why."""
    said = []
    if verdict.steps < verdict.planned:
        said.append(f"it has {verdict.steps} of {counted(verdict.planned, 'step')}")
    if verdict.lacking.total:
        said.append(f"{counted(verdict.lacking.total, 'message')} of the run {_are(verdict.lacking.total)} not in it")
    why = verdict.reason or verdict.damage or ("" if said else "its end is missing")
    return "; ".join([*said, *([why] if why else [])])


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _what_is_wrong(verdict: Verdict) -> str:
    if verdict.first_divergence is not None:
        return divergence_sentence(verdict.first_divergence)
    for faults, word in ((verdict.missing, "missing"), (verdict.duplicates, "contradicted by another of its step")):
        if faults.total:
            first = faults.first[0]
            where = f"the first is {first.topic} of step {first.step}"
            return f"{counted(faults.total, 'message')} {_are(faults.total)} {word}; {where}"
    for fault in (*verdict.strange, *verdict.numbering, *verdict.evidence.wrong):
        return str(fault)
    return "the errors were larger than a disturbance of this size can make them"


def divergence_sentence(first: Divergence) -> str:
    """The first place that is wrong."""
    logged, expected = (
        f'"{value}"' if isinstance(value, str) else brief(value, 6) for value in (first.logged, first.expected)
    )
    if logged == expected:
        logged, expected = repr(first.logged), repr(first.expected)
    return f"at step {first.step}, {first.place} is {logged} where it must be {expected}"


def error_sentence(account: Account) -> str:
    """How large the errors were, and what is promised of them."""
    verdict = account.verdict
    if verdict.peak is None or not account.log.has_plant:
        return "How far off the estimates were is not known: real sensors measured, so nobody knows what was true."
    peak = verdict.peak
    by_it = "The" if verdict.agrees else "By what is recorded, the"
    said = [f"{by_it} estimates of all nodes together were off by {brief(peak.size, 3)} at most, at step {peak.step}."]
    if account.mean_bound is not None:
        bound = float(account.mean_bound[-1])
        above = "" if verdict.peak.size <= bound else " This run was above that, as single runs may be."
        said.append(
            f"Over many such runs the root of the mean square stays below {brief(bound, 3)} at every step; that is "
            f"proved.{above}"
        )
    else:
        said.append(f"No bound in the mean stands beside it: {_why_no_bound(account)}.")
    return " ".join(said)


def _why_no_bound(account: Account) -> str:
    gamma, ledger = account.verdict.gamma, account.verdict.ledger
    if not gamma.is_claimed:
        return "nothing is claimed of these gains"
    if ledger is None or account.is_as_promised:
        return "what is claimed of these gains is not proved"
    return f"what is proved of these gains is of runs without faults, and of this one it says: {ledger.text()}"


def proof_outcome(proof: Proof) -> tuple[str, str]:
    """The outcome in a word, and its mark."""
    if proof.holds is None:
        return "cannot be said", "–"
    return ("holds", "✓") if proof.holds else ("fails", "✗")


def proof_details(proof: Proof, tolerance: float) -> str:
    """How much was looked at, and how close it came."""
    details = [f"{grouped(proof.compared)} {CLAIMS[proof.number][1]}"] if proof.compared else []
    if proof.number <= 3 and proof.compared:
        details.append(f"largest gap {brief(proof.worst_gap, 2)}, allowed {brief(tolerance, 2)}")
    return "; ".join([*details, *([proof.note] if proof.note else [])])


def grouped(count: int) -> str:
    """ "2 000 002", with narrow spaces that do not break."""
    return f"{count:,}".replace(",", "\u202f")
