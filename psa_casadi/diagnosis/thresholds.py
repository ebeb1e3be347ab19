"""Every constant that decides a verdict: where it comes from, and what it is good for.

What a search does with its time (how many fits, from how many starts) stands where it is done;
these here decide what is said. `python -m tests.benchmarks ablation` doubles and halves each.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """The deciding constants.

    Seen at all:

    * `false_alarm`: chance that clean data exceed the threshold of the screening, over all its
      directions. Convention; 0 of 100 clean records were named.
    * `alarm`: probability below which the tests of a residual alarm. Convention.
    * `unseen_alarm`, `unseen_ratio`, `unseen_ratio_of_records`: held-out errors tell that something
      is missing below this probability, and by this ratio of their rms to that of the fit, of whole
      records to their noise. 200 draws each of white and coloured noise: none told.
    * `form_of_range`: share of the range below which no difference between a stack and a model is
      of practical use. 64 simulated records of named stacks are adequate with it.
    * `dithered`: a residual above this multiple of the rounding's rms holds noise enough (a fifth
      of the step) to make rounding white.

    What counts as an explanation:

    * `price`: prior of a cause [nats]. The largest evidence of any effect on 114 of 115 clean
      records was 7.8.
    * `further`: share of what the other causes remove that a further one must. An effect's own form
      is not the true one; less may be that.
    * `static`: share of what a cause with a memory adds that may be a curve of the voltage alone.
      Memories of plants and of measured stacks: 5 to 86 %; gains and loads that a memory imitates:
      91 to 94 %.
    * `form`: share by which a form may miss a contribution: a correction that imitates all but so
      much of the causes is the same explanation; and where structure remains, a further cause that
      removes less, and less than `enough` of what the largest does, is in the model and not named.
    * `held_out`: gain in log-likelihood that held-out samples must show, and all samples together.
    * `most_causes`: of one hypothesis.
    * `ringing`: a resonance near the band is tried where its ringing explains this share of what
      the best effect would.
    * `better`: a hypothesis is looked at again when its rms falls to this share.

    How sure:

    * `temperature`, `temperature_share`: evidence is divided by this, or by this share of the
      largest, before it becomes a probability. From the reliability table of the benchmark
      `diagnose`: the effects are not the true equations.
    * `credible`: probability that the set of effects that cannot be told apart holds the cause.
    * `clearly`: tempered odds [nats] at which an unnamed correction takes names away: 20 to 1.
    * `enough`: share of the held-out excess that causes must remove to be named where structure
      remains; and of what an unnamed correction of their own kind removes, which has more freedom.
      Of the names that were told although structure remained (study, sets of causes, exam) all 16
      that removed less than 66 % were wrong, right ones removed 82 % and more. Beside a correction
      all that removed 52 % and less were wrong, right ones 83 % and more (46 cases).
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
    ringing: float = 0.4
    better: float = 0.95
    temperature: float = 2.0
    temperature_share: float = 0.004
    credible: float = 0.95
    clearly: float = 3.0
    enough: float = 0.7
    follows: float = 0.5
    falling: float = -0.5


_CURRENT: ContextVar[Thresholds] = ContextVar("thresholds", default=Thresholds())  # noqa: B039


def thresholds() -> Thresholds:
    """Return the constants of the diagnosis that is running."""
    return _CURRENT.get()


@contextmanager
def using(constants: Thresholds) -> Iterator[None]:
    """Diagnose with other constants."""
    token = _CURRENT.set(constants)
    try:
        yield
    finally:
        _CURRENT.reset(token)
