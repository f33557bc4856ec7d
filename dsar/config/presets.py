"""The presets: `demo`, `small`, and `paper` with the values of the paper's section 4.1."""

from dsar.config.settings import AtlasConfig, LossConfig, ModelConfig, ScheduleConfig, TrainConfig

PRESETS: dict[str, TrainConfig] = {
    "demo": TrainConfig(),
    "small": TrainConfig(
        preset="small",
        atlas=AtlasConfig(resolution=128, garment_rows=64),
        model=ModelConfig(channels=(32, 64, 96), upsample=4),
        schedule=ScheduleConfig(steps=20000, views=2),
    ),
    "paper": TrainConfig(
        preset="paper",
        workers=1,
        atlas=AtlasConfig(resolution=512, garment="off", weight_smoothing=0.0),
        model=ModelConfig(
            wiring="shared",
            axes="body",
            window=10,
            memory=10,
            acceleration=False,
            mean_time_constants=(),
            prior="none",
            channels=(64, 128, 256, 512),
            heads=8,
            upsample=1,
            uv_feature_channels=0,
            memory_weight=0.1,
            appearance_scale=1.0,
        ),
        loss=LossConfig(
            pyramid=1,
            ssim=0.2,
            lpips=0.5,
            alpha=0.0,
            spatial=0.0,
            shape=0.0,
            registered=0.0,
            residual=0.0,
            temporal_scale=1.0,
            magnitude="frame",
        ),
        schedule=ScheduleConfig(
            steps=300_000,
            learning_rate=6e-4,
            half_resolution_fraction=0.0,
            rollouts_per_worker=1,
            rendered_fraction=1.0,
            chunk_frames=4,
            pretraining_fraction=0.0,
            pose_only_fraction=0.15,
            mirrored_fraction=0.0,
            max_rollout_frames=16,
            muon_rate=0.0,
        ),
    ),
}
