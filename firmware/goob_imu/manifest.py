"""The manifest of Goob's IMU: the payload of DESCRIBE, whose beginning is that of HELLO. A constant.

u8 schema version, u8 number of interfaces, strings: schema hash, device uid, firmware version, model. Per interface:
u16 id, u8 direction (2 out), u8 kind (1 sample, 2 state), u8 flags (2 local only), u16 rate, strings: name, channel,
profile; u8 encoding (1 struct_v1), u8 number of fields; per field: name, u8 type (4 u16, 5 i16, 6 u32), f32 scale,
f32 offset, unit. A string is its length and its bytes. The hash is the CRC-16 of the interfaces: it changes with them.
"""

MANIFEST = (
    b"\x01\x02\x0dgoob-imu-fe78\x08goob-imu\x050.1.0\x11seeed-xiao-samd21"
    # 1: 100 Hz, stays on the robot
    b"\x01\x00\x02\x01\x02\x64\x00\x08imu_fast\x10sensors/imu-fast\x0dimu.motion.v1\x01\x09"
    b"\x02ax\x05\x6f\x12\x83\x3a\0\0\0\0\x04mps2"  # 0.001
    b"\x02ay\x05\x6f\x12\x83\x3a\0\0\0\0\x04mps2"
    b"\x02az\x05\x6f\x12\x83\x3a\0\0\0\0\x04mps2"
    b"\x02gx\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"  # 0.01
    b"\x02gy\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"
    b"\x02gz\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"
    b"\x06temp_c\x05\x0a\xd7\x23\x3c\0\0\0\0\x01c"
    b"\x08roll_deg\x05\x0a\xd7\x23\x3c\0\0\0\0\x03deg"
    b"\x09pitch_deg\x05\x0a\xd7\x23\x3c\0\0\0\0\x03deg"
    # 2: 5 Hz
    b"\x02\x00\x02\x02\x00\x05\x00\x03imu\x0bsensors/imu\x0eimu.summary.v1\x01\x07"
    b"\x0caccel_norm_g\x04\x6f\x12\x83\x3a\0\0\0\0\x01g"
    b"\x0fgyro_bias_x_dps\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"
    b"\x0fgyro_bias_y_dps\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"
    b"\x0fgyro_bias_z_dps\x05\x0a\xd7\x23\x3c\0\0\0\0\x03dps"
    b"\x0asamples_ok\x06\0\0\x80\x3f\0\0\0\0\x00"  # 1.0
    b"\x0dsamples_error\x06\0\0\x80\x3f\0\0\0\0\x00"
    b"\x13calibration_samples\x04\0\0\x80\x3f\0\0\0\0\x00"
)
