"""All records of the exam."""

from tests.studies.exam.record import Record
from tests.studies.exam.records_drive_ceramic import DRIVE_AND_CERAMIC
from tests.studies.exam.records_mechanics_sensor import MECHANICS_AND_SENSOR
from tests.studies.exam.records_others import CLEAN, FOREIGN, TWO_CAUSES

_ONE_CAUSE = sorted((*DRIVE_AND_CERAMIC, *MECHANICS_AND_SENSOR), key=lambda record: record.name)
RECORDS: tuple[Record, ...] = (*CLEAN, *_ONE_CAUSE, *TWO_CAUSES, *FOREIGN)
