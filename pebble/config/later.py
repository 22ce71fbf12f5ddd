"""The config sections of services that later releases bring: typed and checked now, so that files stay valid."""

from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, field

from pebble.config.links import Mqtt
from pebble.config.types import (
    EMPTY,
    AudioChannels,
    BitsPerSecond,
    Command,
    Count,
    File,
    FramesPerSecond,
    Interval,
    LogLevel,
    Pixels,
    Port,
    Qos,
    Rotation,
    SampleRate,
    Seconds,
    Section,
    Service,
    Topic,
    doc,
)

_FRAMES = "pictures and sound travel through the robot's own shared memory, found by transport.run_dir"
_SOURCE = "every frame says its own size and format"
_SHARED_MEMORY = {"socket_path": _FRAMES, "shm_size": _FRAMES, "wait_for_connection": _FRAMES}
_INPUT = {"input_shm": _FRAMES, "input_retry_seconds": _FRAMES}


class CameraCapture(Section, frozen=True, kw_only=True):
    """The camera."""

    retired: ClassVar = _SHARED_MEMORY

    enabled: Annotated[bool, doc("Open the camera.")] = True
    backend: Annotated[
        Literal["v4l2", "libcamera", "arducam", "picamera2", "synthetic"],
        doc("How the camera is reached; `synthetic` needs none."),
    ] = "v4l2"
    device: Annotated[str, doc("Device of a v4l2 camera; or a file or URL that plays its part.")] = "/dev/video0"
    capture_format: Annotated[str, doc("`auto`, `raw`, `mjpeg`, or a pixel format such as `yuyv`.")] = "auto"
    io_mode: Annotated[str | int, doc("Not used: OpenCV knows the best way by itself.")] = "auto"
    camera_name: Annotated[str | None, doc("Which libcamera camera; unset: the first.")] = None
    camera_controls: Annotated[dict[str, Any], doc("Settings handed to the camera as they are.")] = field(
        default_factory=dict
    )
    width: Annotated[Pixels, doc("Pixels.")] = 640
    height: Annotated[Pixels, doc("Pixels.")] = 480
    fps: Annotated[FramesPerSecond, doc("Frames per second.")] = 15
    rotate_degrees: Annotated[Rotation, doc("Clockwise.")] = 0


class Microphone(Section, frozen=True, kw_only=True):
    """The microphone."""

    retired: ClassVar = _SHARED_MEMORY

    enabled: Annotated[bool, doc("Open the microphone.")] = True
    source: Annotated[
        Literal["alsa", "auto", "synthetic"], doc("How the microphone is reached; `synthetic` needs none.")
    ] = "alsa"
    device: Annotated[str | None, doc("ALSA device; unset: the default.")] = None
    rate: Annotated[SampleRate, doc("Samples per second.")] = 16000
    channels: Annotated[AudioChannels, doc("1 is mono, 2 stereo.")] = 1


class AvDaemon(Service, frozen=True, kw_only=True):
    """Owns the camera and the microphone."""

    restart_delay_seconds: Annotated[Seconds, doc("Wait before a failed device is opened again.")] = 2.0
    stop_timeout_seconds: Annotated[Seconds, doc("How long a device may take to close.")] = 5.0
    cwd: Annotated[File | None, doc("Folder to run in.")] = None
    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY
    video: Annotated[CameraCapture, doc("Camera.")] = CameraCapture()
    audio: Annotated[Microphone, doc("Microphone.")] = Microphone()


class VideoStream(Service, frozen=True, kw_only=True):
    """Runs somebody else's streaming program while operators want video."""

    command: Annotated[Command, doc("The program and its arguments, without a shell; required where enabled.")] = ()
    cwd: Annotated[File | None, doc("Folder to run in; unset: the launcher's.")] = None
    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY
    webrtc_url: Annotated[str | None, doc("Where its pictures are shown; operator pages find it in the status.")] = None


class VideoPublisher(Section, frozen=True, kw_only=True):
    """Pictures towards operators."""

    retired: ClassVar = {**_INPUT, "source_*": _SOURCE}

    encoding: Annotated[
        Literal["json", "pbvd", "pbvz", "h264"], doc("How pictures are sent unless a request names another form.")
    ] = "json"
    profile: Annotated[str, doc("Name of this set of values.")] = "default"
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/front-camera`.")] = None
    overlays_topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/video-overlays`.")] = None
    width: Annotated[Pixels | None, doc("Pixels, where publish_width is not set; unset: as captured.")] = None
    height: Annotated[Pixels | None, doc("Pixels, where publish_height is not set; unset: as captured.")] = None
    fps: Annotated[FramesPerSecond | None, doc("Where neither publish_fps nor target_fps is set.")] = None
    publish_width: Annotated[Pixels | None, doc("Pixels of what is sent.")] = None
    publish_height: Annotated[Pixels | None, doc("Pixels of what is sent.")] = None
    publish_fps: Annotated[FramesPerSecond | None, doc("Frames per second of what is sent.")] = None
    target_fps: Annotated[FramesPerSecond | None, doc("Where publish_fps is not set.")] = None
    keyframe_interval: Annotated[Count | None, doc("Frames from one full picture to the next; unset: fps / 3.")] = None
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="1 is worst and smallest.")] = 10
    bitrate: Annotated[BitsPerSecond | None, doc("Of h264, at most; unset: it looks as jpeg_quality does.")] = None
    rotate_degrees: Annotated[Rotation, doc("Clockwise, beyond what the camera's section says.")] = 0
    reconnect_seconds: Annotated[Seconds, doc("Wait between attempts to reach the broker.")] = 10.0


class AudioPublisher(Section, frozen=True, kw_only=True):
    """Sound towards operators."""

    retired: ClassVar = _INPUT

    encoding: Annotated[Literal["pcm", "opus"], doc("How sound is sent unless a request names another form.")] = "pcm"
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/audio`.")] = None
    rate: Annotated[SampleRate | None, doc("Samples per second; unset: as captured.")] = None
    channels: Annotated[AudioChannels | None, doc("1 is mono, 2 stereo; unset: as captured.")] = None
    chunk_ms: Annotated[
        int,
        Meta(ge=1, le=1000, description="Milliseconds of sound in one packet; of opus 20, 40 or 60, and each part."),
    ] = 20
    bitrate: Annotated[int, Meta(ge=6_000, le=256_000, description="Of opus, bits per second.")] = 24_000
    bundle: Annotated[int, Meta(ge=1, le=3, description="How many parts a packet of opus has.")] = 2
    qos: Annotated[Qos | None, doc("Instead of the contract's QoS.")] = None


class AudioReceiver(Section, frozen=True, kw_only=True):
    """Sound from operators."""

    topic: Annotated[Topic | None, doc("Instead of `{base}/incoming/audio-stream`.")] = None
    device: Annotated[str, doc("ALSA device to play on.")] = "default"
    rate: Annotated[SampleRate, doc("Samples per second until a packet says otherwise.")] = 16000
    channels: Annotated[AudioChannels, doc("Channels until a packet says otherwise.")] = 1
    command: Annotated[
        Command, doc("What plays sound from its standard input; `{rate}`, `{channels}` and `{device}` are filled in.")
    ] = ("aplay", "-q", "-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-D", "{device}", "-")
    latency_ms: Annotated[
        int, Meta(ge=0, le=1000, description="Sound that waits to make up for uneven arrival; more where it must.")
    ] = 60
    queue_limit: Annotated[Count, doc("Packets that wait to be played; beyond it the oldest is dropped.")] = 48
    concealment_ms: Annotated[int, Meta(ge=0, le=10_000, description="Longest gap filled with the last packet.")] = 100
    qos: Annotated[Qos | None, doc("Instead of the contract's QoS.")] = None


class Media(Section, frozen=True, kw_only=True):
    """Pictures and sound towards and from operators."""

    video_publisher: Annotated[VideoPublisher, doc("Pictures out.")] = VideoPublisher()
    audio_publisher: Annotated[AudioPublisher, doc("Sound out.")] = AudioPublisher()
    audio_receiver: Annotated[AudioReceiver, doc("Sound in.")] = AudioReceiver()


class HandlerTopics(Section, frozen=True, kw_only=True):
    """Other names for a handler's three topics."""

    command: Annotated[Topic | None, doc("Instead of the contract's incoming command topic.")] = None
    files: Annotated[Topic | None, doc("Instead of the contract's list of files.")] = None
    status: Annotated[Topic | None, doc("Instead of the contract's status.")] = None


class Playback(Section, frozen=True, kw_only=True):
    """Where sounds are and what plays them."""

    directory: Annotated[File | None, doc("Folder of the sounds; unset: `~/sounds`.")] = None
    player_command: Annotated[Command, doc("Player; `{file}` stands for the sound, else it comes last.")] = ("aplay",)
    stop_timeout: Annotated[Seconds, doc("How long the player may take to stop before it is killed.")] = 5.0
    scan_interval: Annotated[float, Meta(ge=1, le=86_400, description="Seconds between looks at the folder.")] = 10.0
    cwd: Annotated[File | None, doc("Folder to run the player in.")] = None
    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY


class SoundboardHandler(Service, frozen=True, kw_only=True):
    """Plays sounds on the robot."""

    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    playback: Annotated[Playback, doc("Sounds and player.")] = Playback()


class ScriptArgument(Section, frozen=True, kw_only=True):
    """One setting of a script that operators may change."""

    key: Annotated[str, doc("Its name in commands.")]
    label: Annotated[str | None, doc("Its name for operators; unset: the key.")] = None
    type: Annotated[Literal["string", "int", "float", "bool", "enum"], doc("What it holds.")] = "string"
    default: Annotated[str | int | float | bool | None, doc("Its value unless a command says otherwise.")] = None
    arg: Annotated[str | None, doc("The option of the script's command line.")] = None
    arg_false: Annotated[str | None, doc("The option that says no.")] = None
    mode: Annotated[Literal["flag", "value"] | None, doc("Whether the option stands alone.")] = None
    required: Annotated[bool, doc("A command must give it.")] = False
    min: Annotated[float | None, doc("Smallest value.")] = None
    max: Annotated[float | None, doc("Largest value.")] = None
    step: Annotated[float | None, doc("Step of an operator's control.")] = None
    options: Annotated[tuple[Any, ...], doc("The values of an enum.")] = ()


class ScriptDependency(Section, frozen=True, kw_only=True):
    """Another script that a script needs."""

    file: Annotated[str, doc("Folder of the other script.")]
    enabled: Annotated[bool, doc("Start it.")] = True
    config: Annotated[dict[str, Any], doc("Its settings.")] = EMPTY


class Script(Section, frozen=True, kw_only=True):
    """One autonomy script: a folder with an entry point."""

    enabled: Annotated[bool, doc("Offer it.")] = True
    display_name: Annotated[str | None, doc("Its name for operators; unset: the folder's.")] = None
    entrypoint: Annotated[str, doc("File to run.")] = "run.py"
    cwd: Annotated[File | None, doc("Folder to run it in; unset: its own.")] = None
    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY
    args: Annotated[tuple[ScriptArgument, ...], doc("Its settings.")] = ()
    dependencies: Annotated[tuple[ScriptDependency, ...], doc("Scripts that must run too.")] = ()


class AutonomyManager(Service, frozen=True, kw_only=True):
    """Runs one autonomy script at a time."""

    autonomy_root: Annotated[str, doc("Folder of the scripts.")] = "autonomy"
    scan_interval_seconds: Annotated[Interval, doc("Seconds between looks at the folder.")] = 5.0
    stop_timeout_seconds: Annotated[Seconds, doc("How long a script may take to stop before it is killed.")] = 8.0
    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY
    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    scripts: Annotated[dict[str, Script], doc("What is known of scripts, by folder.")] = EMPTY


class RosSwitch(Section, frozen=True, kw_only=True):
    """Whether ROS drives the robot."""

    enabled: Annotated[bool, doc("Send drive commands to ROS.")] = True


class RosTopics(Section, frozen=True, kw_only=True):
    """Other names for what the ROS bridge says and hears; unset: the contract's."""

    drive_values: Annotated[Topic | None, doc("Instead of `{base}/incoming/drive-values`.")] = None
    wheel_odometry: Annotated[Topic | None, doc("Instead of `{base}/outgoing/wheel-odometry`.")] = None
    charging_status: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-status`.")] = None
    charging_level: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-level`.")] = None
    localization_pose: Annotated[Topic | None, doc("Instead of `{base}/outgoing/localization-pose`.")] = None
    navigation_status: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation-status`.")] = None
    navigation_goal: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation-goal`.")] = None
    navigation_local_plan: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation/local-plan`.")] = None
    navigation_global_plan: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation/global-plan`.")] = None
    diagnostics: Annotated[Topic | None, doc("Instead of `{base}/outgoing/diagnostics`.")] = None


class RosHeartbeat(Section, frozen=True, kw_only=True):
    """Sign of life of the ROS side."""

    enabled: Annotated[bool, doc("Send it.")] = True
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/online`.")] = None
    interval_seconds: Annotated[float, Meta(ge=0.05, le=3600, description="Seconds between two of them.")] = 0.25
    qos: Annotated[Qos | None, doc("Instead of the contract's QoS.")] = None
    retain: Annotated[bool | None, doc("Instead of the contract's rule whether it is kept.")] = None


class RosNames(Section, frozen=True, kw_only=True):
    """Names on the ROS side."""

    node_name: Annotated[str, doc("ROS node.")] = "pebble_ros1_bridge"
    cmd_vel_topic: Annotated[str, doc("ROS topic of drive commands.")] = "/cmd_vel"
    cmd_vel_publish_interval_seconds: Annotated[Interval, doc("How often a drive command is repeated.")] = 0.05
    odometry_topic: Annotated[str, doc("ROS topic.")] = "/odometry/filtered"
    navigation_status_topic: Annotated[str, doc("ROS topic.")] = "/move_base/status"
    navigation_goal_topic: Annotated[str, doc("ROS topic.")] = "/move_base/current_goal"
    navigation_local_plan_topic: Annotated[str, doc("ROS topic.")] = "/move_base/TrajectoryPlannerROS/local_plan"
    navigation_global_plan_topic: Annotated[str, doc("ROS topic.")] = "/move_base/NavfnROS/plan"
    diagnostics_topic: Annotated[str, doc("ROS topic.")] = "/diagnostics_agg"


class RosMotion(Section, frozen=True, kw_only=True):
    """What a drive value of 1 means to ROS."""

    max_linear_speed_mps: Annotated[float, Meta(gt=0, le=100, description="Metres per second.")] = 0.6
    max_angular_speed_radps: Annotated[float, Meta(gt=0, le=100, description="Radians per second.")] = 1.2


class RosItem(Section, frozen=True, kw_only=True):
    """One report from ROS; QoS, retain and limits unset: as the bridge decides."""

    enabled: Annotated[bool | None, doc("Publish it; unset: all but the two plans and charging_status.")] = None
    interval_seconds: Annotated[Interval | None, doc("Seconds between two of them.")] = None
    qos: Annotated[Qos | None, doc("Delivery quality.")] = None
    retain: Annotated[bool | None, doc("Whether it is kept.")] = None
    max_points: Annotated[Count | None, doc("Points of a plan that are sent.")] = None
    max_items: Annotated[Count | None, doc("Lines of diagnostics that are sent.")] = None
    status_name: Annotated[str | None, doc("Entry of the diagnostics to read.")] = None
    key: Annotated[str | None, doc("Key of that entry to read.")] = None
    truthy_values: Annotated[tuple[str, ...], doc("Texts that mean yes.")] = ()
    falsey_values: Annotated[tuple[str, ...], doc("Texts that mean no.")] = ()


class RosTelemetry(Section, frozen=True, kw_only=True):
    """What the ROS bridge reports."""

    wheel_odometry: Annotated[RosItem, doc("Wheel odometry.")] = RosItem()
    localization_pose: Annotated[RosItem, doc("Pose.")] = RosItem()
    navigation_status: Annotated[RosItem, doc("Navigation.")] = RosItem()
    navigation_goal: Annotated[RosItem, doc("Goal.")] = RosItem()
    navigation_local_plan: Annotated[RosItem, doc("Local plan.")] = RosItem()
    navigation_global_plan: Annotated[RosItem, doc("Global plan.")] = RosItem()
    diagnostics: Annotated[RosItem, doc("Diagnostics.")] = RosItem()
    charging_level: Annotated[RosItem, doc("Battery.")] = RosItem()
    charging_status: Annotated[RosItem, doc("Charging.")] = RosItem()


class RosSafety(Section, frozen=True, kw_only=True):
    """When ROS is told to stop."""

    drive_timeout_seconds: Annotated[float, Meta(gt=0, le=5, description="No drive command for this long: stop.")] = (
        0.75
    )
    ignore_retained_drive: Annotated[bool, doc("Refuse a kept drive command: it is old news.")] = True
    stop_on_shutdown: Annotated[bool, doc("Send a stop at the end.")] = True


class Ros1Bridge(Service, frozen=True, kw_only=True):
    """The link to a ROS 1 robot."""

    drive: Annotated[RosSwitch, doc("Driving.")] = RosSwitch()
    topics: Annotated[RosTopics, doc("Other names for topics.")] = RosTopics()
    heartbeat: Annotated[RosHeartbeat, doc("Sign of life.")] = RosHeartbeat()
    ros: Annotated[RosNames, doc("Names on the ROS side.")] = RosNames()
    motion: Annotated[RosMotion, doc("Speeds.")] = RosMotion()
    telemetry: Annotated[RosTelemetry, doc("Reports.")] = RosTelemetry()
    safety: Annotated[RosSafety, doc("When to stop.")] = RosSafety()


class WebHandler(Service, frozen=True, kw_only=True):
    """Runs the web page on the robot."""

    env: Annotated[dict[str, str], doc("Environment variables to add.")] = EMPTY


class MqttHistory(Section, frozen=True, kw_only=True):
    """A record of all messages."""

    enabled: Annotated[bool, doc("Keep one.")] = False
    uri: Annotated[str, doc("MongoDB to keep it in.")] = "mongodb://127.0.0.1:27017"
    database: Annotated[str, doc("Its database.")] = "pebble"
    collection: Annotated[str, doc("Its collection.")] = "mqtt_history"
    max_bytes: Annotated[int, Meta(ge=1, description="How large it may become.")] = 500 * 1024**3
    subscribe_all_topics: Annotated[bool, doc("Record other systems' topics too.")] = True
    prune_check_every_messages: Annotated[Count, doc("How often its size is looked at.")] = 2000
    prune_chunk_documents: Annotated[Count, doc("How many messages are deleted at once.")] = 50000
    prune_target_ratio: Annotated[float, Meta(gt=0, le=1, description="How full it is after deleting.")] = 0.9


class WebInterface(Section, frozen=True, kw_only=True):
    """The operators' web page."""

    log_level: Annotated[LogLevel, doc("How much it logs; the root's log_level unless set.")] = "INFO"
    host: Annotated[str, doc("Address to listen on.")] = "0.0.0.0"  # noqa: S104 - the operators' page is for others
    port: Annotated[Port, doc("TCP port to listen on.")] = 8080
    mqtt: Annotated[Mqtt, doc("The broker where robots are.")] = Mqtt()
    robots: Annotated[tuple[dict[str, Any], ...], doc("Hints about robots, in the original's form.")] = ()
    robot_discovery: Annotated[dict[str, Any], doc("Read and ignored: robots are found by their messages.")] = field(
        default_factory=dict
    )
    mqtt_history: Annotated[MqttHistory, doc("A record of all messages.")] = MqttHistory()
