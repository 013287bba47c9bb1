"""Writes docs/metrics.md from the code: scorers, length control, findings, rules.

python docs/make_metrics.py           writes it
python docs/make_metrics.py --check   compares it; measured costs may differ

What stands between the two marks of the audit is a person's and stays as it is.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from pathlib import Path
from typing import get_args

from curation_ros.core.decision.rules import RULES, make_rule
from curation_ros.core.episode.findings import FINDINGS
from curation_ros.core.evidence.length_control import MODES
from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS, Need, PoolScorer, Scorer

HERE = Path(__file__).resolve().parent
METRICS = HERE / "metrics.md"
RESULTS = HERE.parent / "benchmarks" / "results.json"
AUDIT_BEGINS, AUDIT_ENDS = "<!-- audit begins -->", "<!-- audit ends -->"
_COST = "- **Cost**: "

#: What decides which end of the score is the good one, by what the scorer needs.
ORIENTS: dict[Need, str] = {
    "nothing": "its definition; whether more of it is better is an assumption",
    "reference": "the trusted demonstrations: more like them is better",
    "dataset": "nothing: more like the majority scores higher, be the majority good or bad",
    "object pose": "the task",
    "rollouts": "the success of a policy",
    "labels": "a person's labels",
}

FORMULAS: dict[str, str] = {
    "smoothness": "-sum_k sqrt((1/(K-1))^2 + (A[k+1] - A[k])^2), A[0..K-1] the amplitude spectrum "
    "of |a_t|, divided by its maximum, up to the last frequency below the cut-off that reaches "
    "the threshold",
    "entropy": "-mean_d std_t(a[t, d])",
    "gripper_timing": "min{t : open(t), closed(s) for some s < t} / T; 1 where there is none",
    "isolation_forest": "-2^(-E[h(x)] / c(n)), h the depth at which a tree isolates x = (mean, "
    "std, max, min, rms of each action dimension), c(n) its mean over n episodes",
    "ensemble": "0.5 * smoothness + 0.5 * gripper_timing",
    "knn": "-(1/k) * sum over the k nearest episodes r of |x - x_r|, x = (mean, std, rms of each "
    "column of state and action), divided by their standard deviations",
    "trajectory_alignment": "m . M / (|m| |M|), m the episode's mean state, M the mean over the "
    "others of theirs",
    "length": "-T",
    "object_coupling": "1/n * #{t in LIFT, TRANSPORT : S(s) <= h for all s <= t}, back to where S "
    "began to rise; S(t) = max(0, S(t-1) + min(|o_t - e_t| - r_t - k, 0.6 h)), o and e the "
    "positions of object and effector, r what their distance was, k = 15 mm + 0.5 sigma, "
    "h = 12 mm + 4 sigma, sigma the noise of o at rest",
    "grip_consistency": "1/n * #{t in LIFT, TRANSPORT : w(s) >= 0.025 W(s) and w(s) - min w <= "
    "0.05 W(s) for all s <= t}, w the gap between the fingers, W its largest so far; with effort "
    "f: f(s) . f(grasp) / |f(grasp)|^2 >= 0.2",
    "phase_events": "-s ln(mean over LIFT, TRANSPORT of exp(-v / s)), v the share of the phase's "
    "steps before the first one commanded open, 1 where there is none; s = 0.1",
}

#: What the code cannot know: where each score misleads.
LIES: dict[str, tuple[str, ...]] = {
    "smoothness": (
        "On the norm of an action with a binary gripper it measures mostly the gripper's "
        "constant: `gripper_channel: false` lets the arm be heard.",
        "Without length control an episode that hovers until the time limit looks smooth: the "
        "score is then mostly length.",
        "It does not see what happens: a bowl that drops from a smooth arm is smooth.",
        "At 20 Hz the cut-off of 10 Hz is half the rate and filters nothing; scores of robots "
        "of different rates do not compare.",
        "In a phase-normalised view time is warped; the rate of the recording is then nominal.",
    ),
    "entropy": (
        "The gripper's channel dominates: an episode that opens early is open most of the time, "
        "varies less, and ranks first: on early releases it is inverted.",
        "It rewards timid motion; only a frozen action abstains.",
    ),
    "gripper_timing": (
        "It detects early releases by construction and nothing else: a slipped object, an empty "
        "grasp or a wrong place score as well as a success.",
        "A release behind the cut of the length control does not exist: 1.0, as if never opened.",
        "Chatter of the command right after the grasp counts as the opening.",
        "It is a share of the steps: where lengths differ, an early release in a long episode "
        "and a late one in a short episode may score alike.",
    ),
    "isolation_forest": (
        "It sees the distribution of actions, not their order or their effect.",
        "Maximum and minimum hang on one sample each: one glitch makes an outlier.",
        "Good demonstrations of another style (slower, another hand) are outliers too.",
    ),
    "ensemble": (
        "Raw, its parts are of different scales, so whichever varies more decides: often it is "
        "one of the two with noise added. `standardised: true` needs a reference.",
        "It inherits what its parts do not see.",
    ),
    "knn": ("It compares statistics over time: the order of events is gone.",),
    "trajectory_alignment": (
        "States are not centred: the cosine of raw positions lies close to 1, and the columns of "
        "the largest numbers (the height of the table) decide. Another origin is another score.",
        "`of: time-mean` has no time axis: the same places in another order score the same.",
        "`of: flattened` compares step by step, so that tempo counts as deviation.",
    ),
    "length": (
        "It is the confound itself: where failures run into the time limit it separates them "
        "perfectly without seeing one. A scorer that it explains has shown nothing.",
    ),
    "object_coupling": (
        "It knows that the object came along, not that it came to the right place, nor that it "
        "was the right one.",
        "The effector's frame must lie between the fingers: from a flange, an object that turns "
        "comes nearer or goes farther.",
        "What slides slowly in the fingers (up to 4 mm a second of an exact pose, more of a noisy "
        "one) is followed, and is a break only after 4 cm.",
        "What is lost in the last two or three steps of TRANSPORT counts as put down.",
        "What was opened early and held all the same (a finger that sticks) scores 1: that is "
        "what happened, not what was commanded.",
        "Of a simulator whose objects at rest repeat their pose to the last bit, an object that "
        "was never touched looks like a tracker that has stopped: it abstains.",
    ),
    "grip_consistency": (
        "What is held may be anything: an object that is not the right one, or a finger's own "
        "stop above the limit of an empty grip.",
        "Objects thinner than 2.5 % of the gripper's opening look like none.",
        "On this simulator's early releases gap and effort show the command that opens, a little "
        "later than the command itself: they are no independent evidence there.",
    ),
    "phase_events": (
        "It detects early openings by construction and nothing else: a slipped object, an empty "
        "grasp or a wrong place score as well as a success.",
        "Phases come from whoever publishes them: a tracker that is wrong about the end of "
        "TRANSPORT makes every opening early, or none.",
        "With phases that a person's gripper defines it says nothing.",
    ),
}
#: What is true of a form that is fitted on a reference, and not of its twin.
_OF_REFERENCE: dict[str, tuple[str, ...]] = {
    "isolation_forest": (
        "A few references make few distinct depths: scores come in steps, and ties are common.",
    ),
    "knn": (
        "A copy of the episode in the reference under another id is its neighbour at distance 0; "
        "so are, nearly, repetitions of one start.",
        "Where the judged set differs from the reference in something harmless (another place "
        "of the object), that distance counts as well.",
    ),
}
_TWINS = (
    "It follows the majority: where most episodes are defective, the defect is typical and the "
    "good ones rank last. Read it beside a scorer whose sign is anchored.",
    "Starts are told apart by `same_start`: too small, and repetitions of one start vouch for "
    "each other; too large, and everything is one start and it abstains.",
    "With few different starts a large share of the dataset is left out for each episode.",
)

HEAD = """# Metrics: what each score means, needs, costs, and when it lies

Made by `docs/make_metrics.py` from the code; edit the docstrings, then run it.

Higher is better for every score. A scorer that cannot score abstains with a reason. The seven of
the paper are as it defines them; where its text leaves a choice open, the first word below is the
default and the others are there as parameters (`scorer_params` of the configuration). SPARC
agrees to 1e-9 with the library of the authors of the measure (monalysa 0.2.1, on PyPI), on
committed inputs and, where that is installed, on generated ones.

A score says how an episode compares, never that it is good. What orients it is said for each:
a scorer that nothing orients says only what is usual, and that turns over with the majority.
"""


def prose(doc: str) -> str:
    """The paragraphs of a Google docstring before its first section, one a line."""
    text = inspect.cleandoc(doc)
    text = re.split(r"^(?:Args|Attributes|Returns|Raises|Source):", text, maxsplit=1, flags=re.M)[
        0
    ]
    paragraphs = []
    for block in text.strip().split("\n\n"):
        if block.startswith("- "):
            paragraphs.append(
                "\n".join("- " + " ".join(i.split()) for i in block[2:].split("\n- "))
            )
        else:
            paragraphs.append(" ".join(block.split()))
    return "\n\n".join(paragraphs)


def section(doc: str, name: str) -> str:
    """The text of a section that begins with `name:`, or nothing."""
    match = re.search(rf"^{name}:\s*(.*?)(?=\n\n|\Z)", inspect.cleandoc(doc), flags=re.M | re.S)
    return " ".join(match.group(1).split()) if match else ""


def arguments(doc: str) -> dict[str, str]:
    """Argument -> its description, of a Google docstring."""
    match = re.search(r"^Args:\n(.*?)(?=\n\S|\Z)", inspect.cleandoc(doc), flags=re.M | re.S)
    found = re.findall(
        r"^    (\w+): (.*?)(?=\n    \w+: |\Z)", match.group(1) if match else "", flags=re.M | re.S
    )
    return {name: " ".join(text.split()) for name, text in found}


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines)


def costs() -> dict[str, str]:
    """Scorer -> what an episode costs, as measured by benchmarks/scorer_cost.py."""
    rows = json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else []
    found = {}
    for row in rows:
        match = re.fullmatch(r"cost of (\w+), episode of (\d+) steps", row["name"])
        if match:
            when = row.get("measured_at", "")
            found[match.group(1)] = (
                f"{row['value']:.0f} µs an episode of {match.group(2)} steps, on one core "
                f"(`{row['command']}`, {when})"
            )
    return found


def parameters(scorer: Scorer) -> str:
    """A table of the hyper-parameters of a scorer."""
    described = arguments(type(scorer).__init__.__doc__ or "")
    rows = []
    for name, value in scorer.params().items():
        default = str(value).lower() if isinstance(value, bool) else str(value)
        others = ", ".join(f"`{w}`" for w in scorer.choices.get(name, ()) if w != value)
        if isinstance(value, bool):
            others = f"`{str(not value).lower()}`"
        rows.append((f"`{name}`", f"`{default}`", others, described[name]))
    if not rows:
        return "No parameters."
    return table(("parameter", "default", "other choices", "meaning"), rows)


def scorer_text(name: str, kind: type[Scorer], cost: dict[str, str]) -> str:
    """The section of one scorer."""
    scorer, doc = kind(), kind.__doc__ or ""
    twin = name.removesuffix("_label_free")
    needs = scorer.needs if scorer.needs != "dataset" else "the unlabelled dataset"
    if name == "ensemble":
        needs += "; a reference with `standardised: true`"
    source = section(doc, "Source") or section(
        inspect.getdoc(inspect.getmodule(kind).spectral_arc_length)
        if name == "smoothness"
        else "",
        "Source",
    )
    lies = LIES[twin] + (_OF_REFERENCE.get(name, ()) if name == twin else _TWINS)
    score = kind._score_features if issubclass(kind, PoolScorer) else kind.look
    what, _, _ = (inspect.getdoc(score) or "").partition("\n\n")
    lines = [
        f"### {name}",
        prose(doc),
        "\n".join(
            [
                f"- **Formula**: `{FORMULAS[twin]}`"
                + (", over the episodes of other starts" if name != twin else ""),
                f"- **Score**: {' '.join(what.split())}",
                *([f"- **Source**: {source}"] if source else []),
                f"- **Needs**: {needs}",
                f"- **Oriented by**: {ORIENTS[scorer.needs]}",
                f"- **Resolution**: {scorer.resolution:g} (differences below it count as none); "
                f"version {scorer.version}"
                + ("" if scorer.length_controlled else "; never length-controlled"),
                f"{_COST}{cost.get(name, 'not measured')}",
            ]
        ),
        parameters(scorer),
        "When it lies:\n" + "\n".join(f"- {lie}" for lie in lies),
    ]
    return "\n\n".join(lines)


def overview() -> str:
    """One line a scorer."""
    rows = [
        (
            f"[{name}](#{name})",
            kind().needs,
            ORIENTS[kind().needs],
            "yes" if name in DEFAULT_SCORERS else "when asked for",
        )
        for name, kind in SCORERS.items()
    ]
    return table(("scorer", "needs", "oriented by", "computed"), rows)


def rule_text(name: str) -> str:
    """The section of one rule."""
    rule = make_rule(name, "")
    parameters = [f"`{k}` ({v})" for k, v in rule.params().items() if k != "scorer"]
    commands = {"`curation score`": rule.decides, "`curation select`": rule.selects}
    used = [command for command, can in commands.items() if can]
    facts = [f"- **Needs**: {rule.needs}", f"- **Used by**: {' and '.join(used)}"]
    if parameters:
        facts.append(f"- **Parameters**: {', '.join(parameters)}")
    return "\n\n".join([f"### Rule {name}", prose(type(rule).__doc__ or ""), "\n".join(facts)])


def text(audit: str) -> str:
    """The whole document."""
    cost = costs()
    kinds = {"recording": "broken recording", "motion": "odd motion", "task": "failed task"}
    parts = [
        HEAD.strip(),
        overview(),
        "## Scorers",
        *(scorer_text(name, kind, cost) for name, kind in SCORERS.items()),
        "## Length control",
        "What every scorer but `length` sees of an episode (`length` and `length_value` of the "
        "configuration). T never comes from labels.",
        table(("mode", "what is seen"), [(f"`{k}`", v) for k, v in MODES.items()]),
        "An episode shorter than T stays whole. With `phase-normalised` every step is a recorded "
        "one, the nearest, and only stamps are interpolated; a phase that an episode lacks is "
        "absent, and without phases in the topic map every length-controlled scorer abstains.",
        "## Gripper",
        "Its meaning is declared once, in the topic map, and refused where the data contradict it "
        "(finding `gripper-meaning`): fingers that move against the declared sign; `binary` "
        "commands of one sign only whose fingers follow both levels (0 only holds, so they could "
        "never both open and close); `continuous` commands beyond the declared ends by more than "
        "a tenth of their distance. A 0 that holds, fingers that do not move, and a glitch are "
        "none.",
        "## Findings",
        table(
            ("id", "kind", "meaning"),
            [(f"`{k}`", kinds[kind], meaning) for k, (kind, meaning) in FINDINGS.items()],
        ),
        "## Rules: from scores to verdicts and selections",
        "`curation score --rule` decides on every episode, `curation select --rule` chooses among "
        "decided ones. A rule that both can use gives both the same answer for the same scored "
        "episodes.",
        table(("rule", "what it does"), [(f"`{k}`", v.summary) for k, v in RULES.items()]),
        *(rule_text(name) for name in RULES),
        "## Audit",
        AUDIT_BEGINS + audit + AUDIT_ENDS,
    ]
    return "\n\n".join(parts) + "\n"


def audit_of(document: str) -> str:
    """What a person wrote between the marks; an empty line where there is nothing yet."""
    before, begins, rest = document.partition(AUDIT_BEGINS)
    inside, ends, _ = rest.partition(AUDIT_ENDS)
    return inside if begins and ends and before else "\n"


def unmeasured(document: str) -> str:
    """The document without figures that differ from one measurement to the next."""
    return re.sub(rf"^{re.escape(_COST)}.*$", _COST, document, flags=re.M)


def main(arguments: list[str]) -> int:
    """Write or check; 1 where the committed document is not current."""
    assert set(LIES) == set(FORMULAS) == {n.removesuffix("_label_free") for n in SCORERS}
    assert set(ORIENTS) == set(get_args(Need))
    old = METRICS.read_text() if METRICS.exists() else ""
    new = text(audit_of(old))
    if arguments == ["--check"]:
        if unmeasured(old) == unmeasured(new):
            return 0
        print(f"{METRICS.name} is not current: run docs/{Path(__file__).name}")  # noqa: T201
        return 1
    METRICS.write_text(new)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
