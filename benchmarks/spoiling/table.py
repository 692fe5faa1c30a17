"""Table of all mistakes."""

from spoiling import of_config, of_logs, of_recordings
from spoiling.folder import Mistake

MISTAKES: dict[str, Mistake] = of_config.MISTAKES | of_logs.MISTAKES | of_recordings.MISTAKES
