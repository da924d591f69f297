"""The guide: a planner that leads the robot round what is in its way. It proposes; the filter decides."""

from guide.guide import DEFAULT_STRENGTH, STRENGTHS, Guide, GuideConfig, Strength

__all__ = ["DEFAULT_STRENGTH", "STRENGTHS", "Guide", "GuideConfig", "Strength"]
