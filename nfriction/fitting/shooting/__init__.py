"""Multiple shooting: residuals, sensitivities, normal equations."""
