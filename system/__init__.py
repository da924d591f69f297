"""What is known of the robot and its sensors: its motion, its ways to stop, and where a hazard can be.

Numbers only, compiled: nothing here decides anything, and nothing knows of QPs, policies or goals.
"""

from system.point_robot import Robot

__all__ = ["Robot"]
