"""Training, checkpoints, evaluation and reports of runs."""

from equirl.training.checkpoint import CheckpointError, load_checkpoint
from equirl.training.environment import describe_task, make_run_env, make_run_expert
from equirl.training.equivariance import replay_observations
from equirl.training.evaluation import Evaluation, evaluate
from equirl.training.export import (
    ExportError,
    check_exported,
    export_actor,
    export_policy,
    load_exported,
    read_certificate,
)
from equirl.training.folder import CHECKPOINT, CONFIG, REPORT, FolderError, load_run_config
from equirl.training.learner import Learner, load_learner
from equirl.training.loop import TrainingRun
from equirl.training.networks import make_networks
from equirl.training.policy import POLICY_SUFFIX, load_policy, save_policy
from equirl.training.seeding import Purpose, scene_seed
from equirl.training.train import train
from equirl.training.video import film_policy

__all__ = [
    "CHECKPOINT",
    "CONFIG",
    "POLICY_SUFFIX",
    "REPORT",
    "CheckpointError",
    "Evaluation",
    "ExportError",
    "FolderError",
    "Learner",
    "Purpose",
    "TrainingRun",
    "check_exported",
    "describe_task",
    "evaluate",
    "export_actor",
    "export_policy",
    "film_policy",
    "load_checkpoint",
    "load_exported",
    "load_learner",
    "load_policy",
    "load_run_config",
    "make_networks",
    "make_run_env",
    "make_run_expert",
    "read_certificate",
    "replay_observations",
    "save_policy",
    "scene_seed",
    "train",
]
