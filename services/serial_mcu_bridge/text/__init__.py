"""Protocols of text lines and their services: `goob_base_v1` of motor boards, `imu_mpu6050_v1` of inertial sensors."""
