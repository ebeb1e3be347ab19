"""What a search for causes works on, by which method, and every constant that decides.

What a search does with its time (how many fits, from how many starts) is set where it is done;
these here decide the verdict. `python -m tests.studies ablation` doubles and halves each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.component import Component
from psa_casadi.records.split import Experiment, fitted


@dataclass(frozen=True)
class Thresholds:
    """The deciding constants.

    Detection:

    * `false_alarm`: chance that clean data exceed the threshold of the screening, over all its
      directions. Convention; 0 of 100 clean records were named.
    * `alarm`: probability below which the tests of a residual alarm. Convention.
    * `unseen_alarm`, `unseen_ratio`, `unseen_ratio_of_records`: held-out errors show that something
      is missing below this probability, and by this ratio of their rms to that of the fit, of whole
      records to their noise. 200 draws each of white and coloured noise: none alarmed.
    * `form_of_range`: share of the range below which no difference between a stack and a model is
      of practical use. 64 simulated records of named stacks are adequate with it.
    * `dithered`: a residual above this multiple of the rounding's rms holds noise enough (a fifth
      of the step) to make rounding white.

    What counts as an explanation:

    * `price`: prior of a cause [nats], and its least evidence where each residual may be noise of a
      separate colour. The largest of any effect on 114 of 115 clean records was 7.8; on 30 with
      odd noise and separate colours 11.2 once.
    * `further`: share of what the other causes remove that a further one must. An effect's form
      is not the true one; less may be that. So is an unnamed correction of another kind as likely
      as a cause within this share of its evidence.
    * `static`: share of what a cause with a memory adds that may be a curve of the voltage alone.
      Memories of plants and of measured stacks: 5 to 86 %; gains and loads that a memory imitates:
      91 to 94 %.
    * `form`: share of the excess that a form may cost: where structure remains, a further cause
      that removes less, and less than `enough` of what the largest does, is in the model and not
      named; causes that are not named stay in the model where they remove more together.
    * `held_out`: gain in log-likelihood that held-out samples must show, and all samples together.
    * `most_causes`: of one hypothesis.

    How sure:

    * `temperature`, `temperature_share`: evidence is divided by this, or by this share of the
      largest, before it becomes a probability. From the reliability table of the benchmark
      `diagnose`: the effects are not the true equations.
    * `form_of_unnamed`: that share where nothing is named. The likeliest of 22 such families
      (exams, study) was right in 7: with 0.02 it would have 94 %, with this 36 %.
    * `unknown`: odds, at one nat a sample, that something which nobody has thought of looks like a
      cause alone. Of 193 names that had 90 % and more (exams, study; two draws of seeds) 173 were
      right: 97 % above half a nat a sample, 81 % below; 96 % alone, 84 % of several. Odds as
      (n/E)^(1/2) and as the number of causes raise the likelihood of that by 8 and 3 nats.
    * `credible`: probability that the set of effects that cannot be separated holds the cause.
    * `clearly`: tempered odds [nats] below which another correction, or another effect in a
      cause's place, is as likely as the best one: 20 to 1.
    * `enough`: share of the held-out excess that causes must remove to be named where structure
      remains. Of the names that were stated although it did (study, sets of causes, exam) all 16
      that removed less than 66 % were wrong, right ones removed 82 % and more. An unnamed
      correction of a cause's kind counts by this share of its evidence: of some 300 names four had
      less, two of them wrong.
    * `follows`, `falling`: share of the displacement's variance that the voltage must explain; and
      correlation with it below which the other sign is tried.
    """

    false_alarm: float = 0.005
    alarm: float = 1e-3
    unseen_alarm: float = 1e-4
    unseen_ratio: float = 1.05
    unseen_ratio_of_records: float = 1.5
    form_of_range: float = 2e-5
    dithered: float = 1.2
    price: float = 8.0
    further: float = 0.02
    static: float = 0.9
    form: float = 0.05
    held_out: float = 1.0
    most_causes: int = 3
    temperature: float = 2.0
    temperature_share: float = 0.004
    form_of_unnamed: float = 0.5
    unknown: float = 0.04
    credible: float = 0.95
    clearly: float = 3.0
    enough: float = 0.7
    follows: float = 0.5
    falling: float = -0.5


#: The default constants of a diagnosis.
LIMITS = Thresholds()

#: Sampling interval [s] below which a stack may ring within the record's band.
FAST = 7e-4
_MASSES = ("m_P", "m_B", "m")
#: Further columns that show the displacement.
_TELL_BENDS = ("displacement_2", "strain")

#: The steps of the method that a diagnosis can go without, to show what each is good for.
STEPS = (
    "one clock",  # readings stay on a separate clock, whatever the data say
    "remainder",  # the noise's colour is that of the residual, not of what nothing explains
    "finite steps",  # effects whose derivative vanishes at their null are not sought by a step
    "fits afresh",  # no fits from an ordinary base besides those from the fitted one
    "other parents",  # a set is fitted from one of its parents only
    "begun again",  # a cause that comes near the end of its range is not fitted once more
    "base again",  # the base is not fitted again from where a cause has led
    "resonances",  # no resonances that the base lacks are tried
    "several modes",  # no series of modes is fitted where one leaves structure
    "several at once",  # causes are added one by one only
    "exchange",  # causes are not exchanged with the later ones
    "all afresh",  # effects far behind in the screening are never fitted
    "rejected",  # no neighbours of what held-out data reject are fitted
    "held out",  # held-out data are not used
    "between samples",  # the voltage between two samples is a straight line, whatever the data say
    "noise",  # noise of another colour may explain as much as a cause
    "form",  # a further cause may be smaller than the first one's form is known
)


#: Work (`timings.Work`) of a search beyond which nothing more is started: some 50 s of processor
#: time. The third longest of the golden cases takes 5.9e8.
BUDGET = 700_000_000


@dataclass(frozen=True)
class Method:
    """The method, `without` some of its `STEPS`, with its deciding constants.

    `budget` is the work of a search (steps of simulations times one more than the derivatives
    with them) beyond which it starts nothing more.
    """

    without: frozenset[str] = frozenset()
    thresholds: Thresholds = LIMITS
    budget: float = BUDGET


#: Why a hypothesis is reported.
State = Literal["fitted", "finished", "visited", "best"]


@dataclass(frozen=True)
class Tried:
    """A hypothesis of a search at the moment that it is reported.

    `state` is why: it was "fitted", its fit went on to its end ("finished"), its neighbours are
    fitted next ("visited"), or it is the answer ("best"). `causes` are added to the base in the
    order in which they were added, so that all but the last are the parent's. `evidence` is ln of
    the Bayes factor over the first base fit, `score` that less the price of the causes. `rms_m`
    and `holdout_rms_m` [m] are the errors in fitted and in held-out samples, `base_rms_m` and
    `noise_rms_m` [m] the held-out error of the base and the noise as both are known by now.
    """

    state: State
    causes: tuple[str, ...]
    evidence: float
    score: float
    rms_m: float
    holdout_rms_m: float
    base_rms_m: float
    noise_rms_m: float


def same_curves(effects: Sequence[Component], fit: Fit) -> tuple[tuple[str, ...], ...]:
    """Return groups of effects that bend the same curve, where the records show no resonance.

    They show one if a `fit` of them needed a mass and a record is fast enough to see it ring. A
    second sensor of the displacement separates them.
    """
    if any(f.column in _TELL_BENDS for f in fit.further):
        return ()
    rings = shows_ringing(fit.experiments) and any(n in fit.unknowns.names for n in _MASSES)
    curves = () if rings else sorted({e.curve for e in effects if e.curve is not None})
    groups = (tuple(e.name for e in effects if e.curve == c) for c in curves)
    return tuple(group for group in groups if len(group) > 1)


def shows_ringing(experiments: Sequence[Experiment]) -> bool:
    """Whether a fitted record is sampled fast enough for a stack to ring within its band."""
    return min(e.record.sample_time for e in fitted(experiments)) < FAST
