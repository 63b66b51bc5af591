"""Torch modules that policies and algorithms are made of: encoder, actor, twin critics, tanh-Gaussian."""
