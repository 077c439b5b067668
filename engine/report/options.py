"""What a user may choose about a report."""

from __future__ import annotations

from dataclasses import dataclass

from engine.report.sheet import Paper, select_paper

__all__ = ["ReportOptions"]


@dataclass(frozen=True)
class ReportOptions:
    """Choices for a report.

    Parameters
    ----------
    paper
        `a4` or `letter`.
    language
        Key of `engine.report.wording.LANGUAGES`.
    title
        Stands in the place of the trial's or the job's name.
    is_anonymous
        Leave out pseudonyms, names of trials and pictures; drawn figures take their place.
    with_file_names
        Name the video files, which may hold names of persons; without them only their hash
        says which videos these were.
    """

    paper: str = "a4"
    language: str = "en"
    title: str = ""
    is_anonymous: bool = False
    with_file_names: bool = False

    @property
    def checked_paper(self) -> Paper:
        """The paper.

        Raises
        ------
        ConfigError
            If there is no such paper.
        """
        return select_paper(self.paper)
