"""Artefacts of torch: TorchScript and `torch.export` programs, read back with suspicion."""
