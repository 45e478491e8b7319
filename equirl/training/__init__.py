"""Training, checkpoints, evaluation and reports of runs."""

from .checkpoint import CheckpointError, load_checkpoint
from .evaluation import Evaluation, evaluate
from .folder import CHECKPOINT, FolderError, load_run_config
from .learner import Learner, load_policy, make_networks
from .loop import TrainingRun, make_run_env
from .seeding import Purpose, scene_seed
from .train import train
from .video import film_policy

__all__ = [
    "CHECKPOINT",
    "CheckpointError",
    "Evaluation",
    "FolderError",
    "Learner",
    "Purpose",
    "TrainingRun",
    "evaluate",
    "film_policy",
    "load_checkpoint",
    "load_policy",
    "load_run_config",
    "make_networks",
    "make_run_env",
    "scene_seed",
    "train",
]
