"""The closed loop in simulation: episodes, tables, pictures."""
