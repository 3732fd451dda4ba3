"""Control of the papers' rig: their future work."""
