"""The avatar: template, posing, garment chart and rollout."""

from dsar.avatar.avatar import Avatar as Avatar
from dsar.avatar.rollout import roll_out as roll_out
