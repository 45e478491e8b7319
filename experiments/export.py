"""Exports the policy of a run to a file that needs torch alone, or an ONNX runtime alone.

Or to a small one that needs equirl, which evaluates and watches it as it does a run.

python experiments/export.py run=outputs/demo format=onnx output=policy.onnx
python experiments/export.py run=outputs/demo format=policy output=policy.pt
python experiments/export.py check=policy.onnx                   # measures its symmetry again
python experiments/export.py check=policy.onnx run=outputs/demo  # and compares it with the run's
"""

from __future__ import annotations

from pathlib import Path

from entry_point import entry_point

from equirl.config import ConfigError, ExportJob


@entry_point("export", ExportJob)
def main(job: ExportJob) -> None:
    """Writes the file, or reads it, and prints what was measured."""
    from equirl.training import POLICY_SUFFIX, save_policy
    from equirl.training.export import FORMATS, check_exported, export_policy, summary

    if job.check:
        certificate = check_exported(job.check, job.run or None, observations=job.observations)
        print(summary(certificate))
        if job.run:
            print(f"\n{_latency(job)}")
        return
    own = job.format == "policy"
    suffix = POLICY_SUFFIX if own else FORMATS[job.format].suffix
    path = Path(job.output or Path(job.run, f"policy{suffix}"))
    if path.suffix != suffix:
        raise ConfigError(f"output={path}: expected a name in {suffix} for format={job.format}")
    if not Path(job.run).is_dir():
        raise ConfigError(f"run={job.run}: expected the folder of a run")
    if own:
        save_policy(job.run, path)
    else:
        print(f"{summary(export_policy(job.run, path, observations=job.observations))}\n")
    print(f"policy: {path}")


def _latency(job: ExportJob, repeats: int = 200) -> str:
    """What one action takes on one thread, by the file and by the run's own networks."""
    import torch
    from measuring import milliseconds, ratio, take_turns

    from equirl.modules import shared_filters
    from equirl.training import load_exported, load_policy
    from equirl.training.export import Observations, as_function

    torch.set_num_threads(1)
    config, actor = load_policy(job.run, "cpu", "auto")
    original, exported = as_function(actor), load_exported(job.check, threads=1)
    size = config.observed_size
    seen = Observations(torch.rand(1, 1, size, size).numpy(), torch.zeros(1, 1).numpy())
    with shared_filters():  # expanded once, as while a run acts
        seconds = take_turns(
            {"file": lambda: exported(*seen), "run": lambda: original(*seen)}, repeats, warm_up=20
        )
    return (
        f"one action, one thread, medians of {repeats}: {milliseconds(seconds['file'])} ms by the "
        f"file, {milliseconds(seconds['run'])} ms by the run's networks; the latter take "
        f"{ratio(seconds['run'], seconds['file'])} times as long"
    )


if __name__ == "__main__":
    main()
