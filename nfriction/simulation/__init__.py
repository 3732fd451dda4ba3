"""Rollouts of plants with friction: compiled, stepped in torch, differentiated."""
