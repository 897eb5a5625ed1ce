"""What belongs to a node's pictures: the pictures, the lights found in them, expected in them, and truly in them."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from buddyline.protocol.messages.fields import Count, Message, NodeId, NonNegative, Positive, StampNs
from buddyline.protocol.messages.node import Blink
from msgspec import UNSET, Meta, Struct, UnsetType

MAX_BLOBS: Final = 64


class Blob(Struct, frozen=True, kw_only=True):
    """One light candidate. Pixel centres at integers, distorted image.

    dt_ns: exposure time of its row minus the frame's stamp_ns. peak: grey levels. score: probability of a light, 0-1.
    lasting_s: for how long its error lasts over the next pictures: twice the integral, over time, of the error's
    autocorrelation. Absent where each picture has an error of its own.
    """

    u_px: float
    v_px: float
    sigma_px: Positive
    area_px: NonNegative
    peak: Annotated[float, Meta(ge=0, le=255)]
    elongation: NonNegative
    dt_ns: int = 0
    score: Annotated[float, Meta(ge=0, le=1)] | UnsetType = UNSET
    lasting_s: Annotated[float, Meta(ge=0, le=3600)] | UnsetType = UNSET


class Candidates(Message, frozen=True, kw_only=True):
    """Light candidates of one frame, the most likely first.

    stamp_ns: middle of exposure of the image's middle row. trigger: round(stamp_ns / trigger_period_ns).
    seq: sequence number, from 0 at each boot. truncated: number of candidates left out. elsewhere: only where parts of
    the picture were not searched: how many candidates the last search of the whole picture found in these parts.
    exposure_ns, gain: of this frame. context: whether it was exposed for the scene and not for the lamps. All three are
    absent where not known.
    """

    node: NodeId
    stamp_ns: StampNs
    trigger: Count
    seq: Count
    boot: str
    width_px: Annotated[int, Meta(ge=1, le=65535)]
    height_px: Annotated[int, Meta(ge=1, le=65535)]
    blobs: Annotated[list[Blob], Meta(max_length=MAX_BLOBS)]
    truncated: Count = 0
    elsewhere: Count | UnsetType = UNSET
    exposure_ns: Count | UnsetType = UNSET
    gain: Positive | UnsetType = UNSET
    context: bool | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check that every blob is inside the picture."""
        for i, blob in enumerate(self.blobs):
            if not -0.5 <= blob.u_px <= self.width_px - 0.5:
                raise ValueError(f"blobs[{i}].u_px: {blob.u_px:g} is outside the image, width {self.width_px}")
            if not -0.5 <= blob.v_px <= self.height_px - 0.5:
                raise ValueError(f"blobs[{i}].v_px: {blob.v_px:g} is outside the image, height {self.height_px}")


class ExpectedLight(Struct, frozen=True, kw_only=True):
    """Where one light should stand in a picture. Pixel centres at integers, distorted image.

    covariance_px2: [uu, uv, vv]. rate_pxps: [u, v], how the place moves. sigma_rate_pxps: by how much the sigma grows
    with each second after the stamp.
    """

    side: Literal["left", "right"]
    u_px: float
    v_px: float
    covariance_px2: tuple[Positive, float, Positive]
    rate_pxps: tuple[float, float]
    sigma_rate_pxps: NonNegative

    def __post_init__(self) -> None:
        """Check that the covariance is positive definite."""
        uu, uv, vv = self.covariance_px2
        if not uv * uv < uu * vv:
            raise ValueError("covariance_px2: not positive definite")


class Expect(Message, frozen=True, kw_only=True):
    """Where the solver's track expects the lights of the node `seen` in a later picture of the node `node`.

    stamp_ns: the instant of the prediction, on node's clock; usually that of node's next picture. It serves until
    valid_ns after the stamp. lights: those that should be in the picture; the others are left out. blink: how a lamp of
    `seen` blinks: while it is dark it is in no picture.
    """

    node: NodeId
    seen: NodeId
    stamp_ns: StampNs
    valid_ns: Annotated[int, Meta(ge=1, le=10_000_000_000)]
    lights: Annotated[list[ExpectedLight], Meta(max_length=2)]
    blink: Blink | UnsetType = UNSET


class FoxgloveTime(Struct, frozen=True, kw_only=True):
    """A Foxglove timestamp."""

    sec: Annotated[int, Meta(ge=0, le=2**32 - 1)]
    nsec: Annotated[int, Meta(ge=0, le=999_999_999)]


class CompressedImage(Message, frozen=True, kw_only=True):
    """A frame as JPEG or PNG (foxglove.CompressedImage); frame_id is `<node>_camera`."""

    timestamp: FoxgloveTime
    frame_id: str
    data: bytes
    format: str

    @property
    def stamp_ns(self) -> int:
        """Middle of exposure of the image's middle row."""
        return self.timestamp.sec * 1_000_000_000 + self.timestamp.nsec


class TrueLight(Struct, frozen=True, kw_only=True):
    """The true place of one light of another node in a picture. merged: both lights' clipped cores overlap.

    node: whose light it is, where there are more than two nodes.
    """

    name: Literal["left", "right"]
    u_px: float
    v_px: float
    visible: bool
    merged: bool
    node: NodeId | UnsetType = UNSET


class LightTruth(Message, frozen=True, kw_only=True):
    """The true places of the other nodes' lights in this node's picture."""

    node: NodeId
    stamp_ns: StampNs
    trigger: Count
    lights: list[TrueLight]
