"""Variants and baselines of the paper's network, each in place of one of its parts.

`dsar.network.build` chooses.

* `offset_wiring`: a frame is encoded once, not at every step of the window (`model.wiring`).
* `mean_readout`: the mean of all rows of the window's attention (`model.readout`, `model.causal`).
* `feature_bank`: a memory bank of features that no attention has seen (`model.bank`).
* `linear_bases`: a mixture of fixed maps in place of the decoder (`model.bases`).

A variant of the network's input is `dsar.avatar.principal_poses` (`model.pose_components`).
"""
