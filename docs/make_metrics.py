"""Writes docs/metrics.md from the code: scorers, length control, findings, rules.

python docs/make_metrics.py           writes it
python docs/make_metrics.py --check   compares it; measured costs may differ

The text between the two marks of the audit is written by hand and stays as it is.
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
from curation_ros.testing.scorers import SCORER_RULES

HERE = Path(__file__).resolve().parent
METRICS = HERE / "metrics.md"
RESULTS = HERE.parent / "benchmarks" / "results.json"
AUDIT_BEGINS, AUDIT_ENDS = "<!-- audit begins -->", "<!-- audit ends -->"
_COST = "- **Cost**: "

#: What decides which end of the score is the good one, by what the scorer needs.
ORIENTS: dict[Need, str] = {
    "nothing": "its definition; that more of it is better is an assumption",
    "reference": "the trusted demonstrations: more similar is better",
    "dataset": "nothing: episodes like the majority score higher, whether good or bad",
    "object pose": "the task",
    "rollouts": "the success of a policy",
    "labels": "a person's labels",
}

FORMULAS: dict[str, str] = {
    "smoothness": "-sum_k sqrt((1/(K-1))^2 + (A[k+1] - A[k])^2), A[0..K-1] the amplitude spectrum "
    "of |a_t|, divided by its maximum, up to the last frequency below the cut-off that reaches "
    "the threshold",
    "entropy": "-mean_d std_t(a[t, d])",
    "gripper_timing": "min{t : open(t), closed(s) for some s < t} / T; 1 if there is none",
    "isolation_forest": "-2^(-E[h(x)] / c(n)), h the depth at which a tree isolates x = (mean, "
    "std, max, min, rms of each action dimension), c(n) its mean over n episodes",
    "ensemble": "0.5 * smoothness + 0.5 * gripper_timing",
    "knn": "-(1/k) * sum over the k nearest episodes r of |x - x_r|, x = (mean, std, rms of each "
    "column of state and action), divided by their standard deviations",
    "trajectory_alignment": "m . M / (|m| |M|), m the episode's mean state, M the mean of those "
    "of the others",
    "length": "-T",
    "object_coupling": "1/n * #{t in LIFT, TRANSPORT : S(s) <= h for all s <= t}, back to where S "
    "began to rise; S(t) = max(0, S(t-1) + min(|o_t - e_t| - r_t - k, 0.6 h)), o and e the "
    "positions of object and effector, r their distance before, k = 15 mm + 0.5 sigma, "
    "h = 12 mm + 4 sigma, sigma the noise of o at rest",
    "grip_consistency": "1/n * #{t in LIFT, TRANSPORT : w(s) >= 0.025 W(s) and w(s) - min w <= "
    "0.05 W(s) for all s <= t}, w the gap between the fingers, W its largest so far; with effort "
    "f: f(s) . f(grasp) / |f(grasp)|^2 >= 0.2",
    "phase_events": "-s ln(mean over LIFT, TRANSPORT of exp(-v / s)), v the share of the phase's "
    "steps before the first one commanded open, 1 if there is none; s = 0.1",
}

#: What the code cannot know: when each score misleads.
MISLEADS: dict[str, tuple[str, ...]] = {
    "smoothness": (
        "With a binary gripper in the action, the norm measures mostly the gripper's constant. "
        "`gripper_channel: false` measures the arm.",
        "Without length control, an episode that hovers until the time limit looks smooth. The "
        "score then is mostly length.",
        "It does not see the object: a bowl that drops from a smooth arm is smooth.",
        "At 20 Hz the cut-off of 10 Hz is half the rate and filters nothing. Scores of robots "
        "with different rates cannot be compared.",
        "Phase-normalised episodes have warped time. The rate of the recording is then nominal.",
    ),
    "entropy": (
        "The gripper's channel dominates. An episode that opens early is open most of the time, "
        "varies less, and ranks first: on early releases the score is inverted.",
        "It rewards timid motion. It abstains only if the action never changes.",
    ),
    "gripper_timing": (
        "It detects early releases by construction and nothing else. A slipped object, an empty "
        "grasp and a wrong place score like a success.",
        "A release after the cut of the length control is not seen: it scores 1.0, as if the "
        "gripper had never opened.",
        "If the command chatters right after the grasp, that counts as the opening.",
        "It is a share of the steps. If lengths differ, an early release in a long episode and a "
        "late one in a short episode may score alike.",
    ),
    "isolation_forest": (
        "It sees the distribution of actions, neither their order nor their effect.",
        "Maximum and minimum depend on one sample each: one glitch makes an outlier.",
        "Good demonstrations in another style (slower, another operator) are outliers as well.",
    ),
    "ensemble": (
        "The raw parts have different scales, so the one that varies more decides. Often the sum "
        "is one part with noise added. `standardised: true` needs a reference.",
        "What its parts miss, it misses as well.",
    ),
    "knn": ("It compares statistics over time, so the order of events is lost.",),
    "trajectory_alignment": (
        "States are not centred. The cosine of raw positions is close to 1, and the columns with "
        "the largest numbers (the height of the table) decide. The score depends on the origin.",
        "`of: time-mean` has no time axis: the same places in another order score the same.",
        "`of: flattened` compares step by step, so a different pace counts as a deviation.",
    ),
    "length": (
        "It is the confound itself. If failures run into the time limit, it separates them "
        "perfectly without seeing one. A scorer that length explains has shown nothing.",
    ),
    "object_coupling": (
        "It knows that the object was carried. It knows neither whether that was the right object "
        "nor whether it reached the right place.",
        "The effector's frame must lie between the fingers. Seen from a flange, an object that "
        "turns comes nearer or moves away.",
        "An object that slides slowly in the fingers is followed, up to 4 mm per second with an "
        "exact pose and more with a noisy one. The carry breaks only after 4 cm.",
        "An object that is lost in the last two or three steps of TRANSPORT counts as put down.",
        "An object that is still held after an early opening (a finger that sticks) scores 1. The "
        "score is about what happened, not about what was commanded.",
        "In a simulator, an object at rest may repeat its pose to the last bit. If it was never "
        "touched, that looks like a tracker that has stopped: the scorer abstains.",
    ),
    "grip_consistency": (
        "The fingers may hold anything: the wrong object, or their own mechanical stop if it lies "
        "above the limit of an empty grip.",
        "Objects thinner than 2.5 % of the gripper's opening look like none.",
        "On this simulator's early releases, gap and effort show the opening command, a little "
        "later than the command itself. They are no independent evidence there.",
    ),
    "phase_events": (
        "It detects early openings by construction and nothing else. A slipped object, an empty "
        "grasp and a wrong place score like a success.",
        "It trusts the publisher of the phases. If that is wrong about the end of TRANSPORT, "
        "every opening is early, or none is.",
        "If the phases are defined by the operator's gripper, it says nothing.",
    ),
}
#: What is true of a form that is fitted on a reference, and not of its twin.
_OF_REFERENCE: dict[str, tuple[str, ...]] = {
    "isolation_forest": (
        "A few references give few distinct depths: scores come in steps, and ties are common.",
    ),
    "knn": (
        "A copy of the episode in the reference, under another id, is its neighbour at distance "
        "0. Repetitions of one start are nearly so.",
        "If the scored set differs from the reference in something harmless (another place of the "
        "object), that distance counts as well.",
    ),
}
_TWINS = (
    "It follows the majority. If most episodes are defective, the defect is typical and good "
    "episodes rank last. Read it next to a scorer whose direction is fixed.",
    "`same_start` separates starts. If it is too small, repetitions of one start count as "
    "independent. If it is too large, there is only one start and the scorer abstains.",
    "With few different starts, a large share of the dataset is left out for each episode.",
)

HEAD = """# Metrics: what each score means, needs and costs, and when it misleads

Made by `docs/make_metrics.py` from the code. To change it, edit the docstrings and run that.

Higher is better for every score. A scorer that cannot score abstains with a reason. The seven
scorers of the paper follow its definitions. If its text leaves a choice open, the first value
below is the default, and the others are parameters (`scorer_params` of the configuration). SPARC
agrees to 1e-9 with the library of the authors of the measure (monalysa 0.2.1, on PyPI), on
committed inputs and, if that library is installed, on generated ones.

A score shows how an episode compares, never that it is good. For each scorer this page names what
orients it, that is, what makes one end of the scale the good end. A scorer without orientation
only shows what is usual, and is inverted if the majority is bad.

`curation scorers` lists these scorers and those of other packages.
"""

OWN_SCORER = """A scorer is a class with one method, `look`. Put it into a package of your own and
offer it as an entry point; no file of this package changes. In `pyproject.toml`:

```toml
[project.entry-points."curation_ros.scorers"]
pauses = "my_package.pauses:Pauses"
```

After `pip install`, `curation scorers` lists it, and configurations and commands accept its name.
Derive the class from `curation_ros.core.scorers.Scorer`. This test shows what it must do:

```python
import pytest
from curation_ros.testing.scorers import SCORER_RULES, check_scorer
from my_package.pauses import Pauses


@pytest.mark.parametrize("rule", SCORER_RULES)
def test_pauses(rule):
    check_scorer(Pauses, rules=[rule])
```

The rules:
"""


def prose(doc: str) -> str:
    """The paragraphs of a Google docstring before its first section, one per line."""
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
    """Scorer -> cost per episode, as measured by benchmarks/scorer_cost.py."""
    rows = json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else []
    found = {}
    for row in rows:
        match = re.fullmatch(r"cost of (\w+), episode of (\d+) steps", row["name"])
        if match:
            when = row.get("measured_at", "")
            found[match.group(1)] = (
                f"{row['value']:.0f} µs per episode of {match.group(2)} steps, on one core "
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
    misleads = MISLEADS[twin] + (_OF_REFERENCE.get(name, ()) if name == twin else _TWINS)
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
                f"- **Resolution**: {scorer.resolution:g} (smaller differences do not count); "
                f"version {scorer.version}"
                + ("" if scorer.length_controlled else "; always sees the whole episode"),
                f"{_COST}{cost.get(name, 'not measured')}",
            ]
        ),
        parameters(scorer),
        "When it misleads:\n" + "\n".join(f"- {text}" for text in misleads),
    ]
    return "\n\n".join(lines)


def overview() -> str:
    """One line per scorer."""
    rows = [
        (
            f"[{name}](#{name})",
            kind().needs,
            ORIENTS[kind().needs],
            "by default" if name in DEFAULT_SCORERS else "if named",
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
        "## A scorer of your own",
        OWN_SCORER.strip(),
        "\n".join(f"- {rule}" for rule in SCORER_RULES),
        "## Length control",
        "The part of an episode that length-controlled scorers see (`length` and `length_value` "
        "of the configuration). T never comes from labels.",
        table(("mode", "what is seen"), [(f"`{k}`", v) for k, v in MODES.items()]),
        "An episode shorter than T stays whole. With `phase-normalised` every step is the nearest "
        "recorded one, and only stamps are interpolated. A phase that an episode lacks is left "
        "out. Without phases in the topic map every length-controlled scorer abstains.",
        "## Gripper",
        "The topic map declares the meaning of the gripper's command once. If the data contradict "
        "it, the episode gets the finding `gripper-meaning`. These are contradictions:",
        "- fingers that move against the declared sign\n"
        "- `binary` commands of one sign only whose fingers follow both levels (0 holds the "
        "previous command, so these could never both open and close)\n"
        "- `continuous` commands beyond the declared ends by more than a tenth of their distance",
        "A 0 that holds, fingers that do not move, and a glitch are no contradictions.",
        "## Findings",
        table(
            ("id", "kind", "meaning"),
            [(f"`{k}`", kinds[kind], meaning) for k, (kind, meaning) in FINDINGS.items()],
        ),
        "## Rules: from scores to verdicts and selections",
        "`curation score --rule` decides on every episode. `curation select --rule` chooses among "
        "decided ones. A rule that both can use gives both the same answer for the same scored "
        "episodes.",
        table(("rule", "what it does"), [(f"`{k}`", v.summary) for k, v in RULES.items()]),
        *(rule_text(name) for name in RULES),
        "## Audit",
        AUDIT_BEGINS + audit + AUDIT_ENDS,
    ]
    return "\n\n".join(parts) + "\n"


def audit_of(document: str) -> str:
    """The text between the marks, which is written by hand; an empty line if there is none."""
    before, begins, rest = document.partition(AUDIT_BEGINS)
    inside, ends, _ = rest.partition(AUDIT_ENDS)
    return inside if begins and ends and before else "\n"


def unmeasured(document: str) -> str:
    """The document without measured figures."""
    return re.sub(rf"^{re.escape(_COST)}.*$", _COST, document, flags=re.M)


def main(arguments: list[str]) -> int:
    """Write or check; 1 if the committed document is not current."""
    assert set(MISLEADS) == set(FORMULAS) == {n.removesuffix("_label_free") for n in SCORERS}
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
