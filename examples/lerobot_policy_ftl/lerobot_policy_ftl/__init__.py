"""Concepts of ftl-lightning as policies of LeRobot, which imports this package by its name and so registers the type ``ftl``."""

from lerobot_policy_ftl.configuration_ftl import FtlConfig
from lerobot_policy_ftl.modeling_ftl import FtlPolicy
from lerobot_policy_ftl.processor_ftl import make_ftl_pre_post_processors

__all__ = ["FtlConfig", "FtlPolicy", "make_ftl_pre_post_processors"]
