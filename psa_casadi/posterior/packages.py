"""The packages of the extra `sample`, loaded where a posterior is asked for."""

import warnings
from importlib import import_module
from typing import Any

from psa_casadi.errors import InputError


def sampler_and_arviz() -> tuple[Any, Any]:
    """Return the modules nutpie and arviz. Raises InputError where one is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # arviz tells of its next version
            return import_module("nutpie"), import_module("arviz")
    except ImportError as error:
        raise InputError(
            f"A posterior needs nutpie and ArviZ ({error.name} is not installed); run"
            " `pip install 'psa-casadi[sample]'`. `psa identify` gives intervals without them."
        ) from error
