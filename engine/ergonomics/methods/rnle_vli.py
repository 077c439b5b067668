"""The variable lifting index, for work whose lifts differ all the time. Experimental."""

from __future__ import annotations

from engine.datatypes import RiskResult
from engine.ergonomics.base import Exposure, MethodInfo
from engine.ergonomics.lifting_equation import Duration
from engine.ergonomics.lifting_job import N_VLI_CATEGORIES, compute_vli
from engine.ergonomics.methods.rnle import LEVELS, classify
from engine.ergonomics.methods.rnle_job import METHOD as JOB
from engine.ergonomics.work import refuse

__all__ = ["METHOD"]


class RnleVli:
    """The variable lifting index (VLI)."""

    info = MethodInfo(
        name="rnle_vli",
        title="Variable lifting index of the job",
        reference="Waters, Occhipinti, Colombini, Alvarez-Casado & Fox (2016), Human Factors "
        "58(5):695-711: six categories [V1]; their grouping recalled, not checked [R].",
        verification="R",
        levels=LEVELS,
        value_name="variable lifting index",
        description="All lifts of the trial as a sample of the job, in six groups by their "
        "frequency-independent index. Experimental: meant for many different lifts.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge the job; without an interval."""
        job = JOB.assess(exposure)
        if not job.is_applicable:
            return refuse(self.info, *job.reasons)
        tasks = job.details["tasks"]
        frequency = job.details["frequency_per_min"]
        duration = Duration(job.details["duration_class"])
        value = compute_vli([task["FILI"] for task in tasks], frequency, duration)
        level = classify(value)
        doubts = ["experimental: the grouping of the lifts was not checked"]
        if len(tasks) < N_VLI_CATEGORIES:
            doubts.append(
                f"fewer than {N_VLI_CATEGORIES} lifts can't fill the categories: too few for this "
                "index; see the composite one"
            )
        doubts += job.details["doubts"]
        return RiskResult(
            method=self.info.name,
            value=value,
            category="unknown" if level is None else level.name,
            inputs=job.inputs,
            steps=(
                "FILI of the lifts: " + ", ".join(f"{task['FILI']:.2f}" for task in tasks),
                (
                    f"Sorted into at most {N_VLI_CATEGORIES} equal groups that share "
                    f"{frequency:.3g} lifts per minute, {duration} duration"
                ),
                f"VLI = {value:.2f}",
            ),
            reference=self.info.reference,
            reasons=(*job.details["assumptions"], *doubts),
            details={
                "vli": value,
                "cli": job.value,
                "n_lifts": len(tasks),
                "assumptions": job.details["assumptions"],
                "doubts": doubts,
            },
        )


METHOD = RnleVli()
