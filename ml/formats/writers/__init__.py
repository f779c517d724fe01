"""Writers of device files with a known delivered dose and a known true time, from the formats' public descriptions.

They share nothing with the decoders, so that what a decoder takes for granted is not true by construction. A fault of the
field, such as a counter that turns or a log that ends early, is a choice of the writer. The truth stays known.
"""

from ml.formats.writers.percept import PerceptRun, PerceptWorld, write_percept
from ml.formats.writers.summit import RcsWorld, write_rcs
from ml.formats.writers.truth import Course, Truth

__all__ = ["Course", "PerceptRun", "PerceptWorld", "RcsWorld", "Truth", "write_percept", "write_rcs"]
