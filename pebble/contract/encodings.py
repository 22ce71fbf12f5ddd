"""The encodings of pictures and sound, by the names that requests, capabilities and configs use."""

from typing import Final, Literal, TypeAlias, get_args

VideoEncoding: TypeAlias = Literal["json", "pbvd", "h264"]
SoundEncoding: TypeAlias = Literal["pcm", "opus"]
ALL_VIDEO: Final[tuple[VideoEncoding, ...]] = get_args(VideoEncoding)
ALL_SOUND: Final[tuple[SoundEncoding, ...]] = get_args(SoundEncoding)
NEED_PYAV: Final = frozenset({"h264", "opus"})
