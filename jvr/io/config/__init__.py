"""Configurations: TOML files that say what is rendered and fitted. Strings end here; what comes out are objects of `jvr`."""

from jvr.io.config.build import FitJob as FitJob
from jvr.io.config.build import build_cameras as build_cameras
from jvr.io.config.build import build_fit as build_fit
from jvr.io.config.build import build_scene as build_scene
from jvr.io.config.build import build_settings as build_settings
from jvr.io.config.build import build_start as build_start
from jvr.io.config.build import build_volume as build_volume
from jvr.io.config.build import interpolated as interpolated
from jvr.io.config.errors import ConfigError as ConfigError
from jvr.io.config.load import Config as Config
from jvr.io.config.load import config_from as config_from
from jvr.io.config.load import read_config as read_config
from jvr.io.config.transfers import read_transfer as read_transfer
from jvr.io.config.transfers import write_transfer as write_transfer
