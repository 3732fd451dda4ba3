"""Control of the papers' rig, which they name as future work."""
