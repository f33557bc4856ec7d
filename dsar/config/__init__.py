"""The settings of a run, the presets, and config.json."""

from dsar.config.files import absolute_capture as absolute_capture
from dsar.config.files import config_from_json as config_from_json
from dsar.config.files import config_to_json as config_to_json
from dsar.config.files import with_absolute_paths as with_absolute_paths
from dsar.config.presets import PRESETS as PRESETS
from dsar.config.settings import EMBEDDED as EMBEDDED
from dsar.config.settings import EMBEDDED_CAPTURES as EMBEDDED_CAPTURES
from dsar.config.settings import AtlasConfig as AtlasConfig
from dsar.config.settings import LossConfig as LossConfig
from dsar.config.settings import ModelConfig as ModelConfig
from dsar.config.settings import ScheduleConfig as ScheduleConfig
from dsar.config.settings import TrainConfig as TrainConfig
