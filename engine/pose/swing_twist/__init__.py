"""Swing-twist inverse kinematics of a plain skeleton of 29 joints, in the manner of HybrIK."""
