"""Equivariant reinforcement learning of robot manipulation, on TorchRL.

The rooms, in the order to read them; each states its public names in its ``__init__``:

* `equirl.symmetry`: groups, and how each tensordict key transforms;
* `equirl.modules`: steerable networks, actor and critic;
* `equirl.objectives`: the losses;
* `equirl.data`: the replay buffer and its transforms;
* `equirl.envs`: the simulated cell, its tasks and their experts;
* `equirl.collectors`: demonstrations and experience;
* `equirl.training`: runs, from a configuration (`equirl.config`) to a report;
* `equirl.analysis`: statistics and curves of finished runs.

Importing this package loads none of them.
"""

from importlib.metadata import version

__version__ = version("equirl")
