"""The devices of which there are public records, and every dataset by name."""

from psa_casadi.datasets.devices.micromanipulator import MICROMANIPULATOR, MICROMANIPULATOR_RESTS
from psa_casadi.datasets.devices.steering_mirror import STEERING_MIRROR, STEERING_MIRROR_TEST
from psa_casadi.datasets.published import Dataset

_ALL = (MICROMANIPULATOR, MICROMANIPULATOR_RESTS, STEERING_MIRROR, STEERING_MIRROR_TEST)

#: Every dataset by name. A dataset stands here once its licence and its hashes were verified.
DATASETS: dict[str, Dataset] = {d.name: d for d in _ALL}
