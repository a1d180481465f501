"""What was measured: records, files, findings before any model, and excitation.

record      the record, immutable
read        from a file to a record
readers     file formats, one a module
channels    arrays, names, units and measured quantities made uniform
clock       from a time column to a uniform grid
stamped     samples at times of their own
joining     several records of one system
cleaning    samples that say nothing made missing
periods     repetition of a signal, and averages over periods
checks      findings before any model
describe    a record on one screen
excitation  inputs worth applying
"""

from jaxgray.records.checks.finding import RecordFinding as RecordFinding
from jaxgray.records.checks.preflight import preflight as preflight
from jaxgray.records.excitation import Multisine as Multisine
from jaxgray.records.excitation import chirp as chirp
from jaxgray.records.excitation import multisine as multisine
from jaxgray.records.excitation import prbs as prbs
from jaxgray.records.excitation import random_steps as random_steps
from jaxgray.records.excitation import white as white
from jaxgray.records.joining import check_compatible as check_compatible
from jaxgray.records.joining import concatenate as concatenate
from jaxgray.records.joining import on_one_grid as on_one_grid
from jaxgray.records.joining import record_of as record_of
from jaxgray.records.joining import records_of as records_of
from jaxgray.records.read import RecordWarning as RecordWarning
from jaxgray.records.read import read_record as read_record
from jaxgray.records.record import PeriodAverage as PeriodAverage
from jaxgray.records.record import Record as Record
