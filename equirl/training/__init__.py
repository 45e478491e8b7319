"""Training, checkpoints, evaluation and reports of runs."""

from equirl.training.checkpoint import CheckpointError, load_checkpoint
from equirl.training.environment import describe_task, make_run_env, make_run_expert
from equirl.training.evaluation import Evaluation, evaluate
from equirl.training.folder import CHECKPOINT, CONFIG, REPORT, FolderError, load_run_config
from equirl.training.learner import Learner, load_policy
from equirl.training.loop import TrainingRun
from equirl.training.networks import make_networks
from equirl.training.seeding import Purpose, scene_seed
from equirl.training.train import train
from equirl.training.video import film_policy

__all__ = [
    "CHECKPOINT",
    "CONFIG",
    "REPORT",
    "CheckpointError",
    "Evaluation",
    "FolderError",
    "Learner",
    "Purpose",
    "TrainingRun",
    "describe_task",
    "evaluate",
    "film_policy",
    "load_checkpoint",
    "load_policy",
    "load_run_config",
    "make_networks",
    "make_run_env",
    "make_run_expert",
    "scene_seed",
    "train",
]
