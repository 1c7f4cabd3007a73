//! Writes movies: AV1 in MP4, which browsers and VLC play.
//!
//! Grey movies use AV1's main profile (4:2:0, neutral chroma planes), which every decoder supports. Colour movies have
//! full chroma resolution (4:4:4, high profile). Levels follow BT.709, from 16 to 235. With these quantizers every
//! frame has a PSNR above 40 dB, even noise.

use std::io::{Seek, SeekFrom, Write};
use std::num::NonZeroU32;

use ndarray::ArrayView2;
use rav1e::prelude::{
    ChromaSampling, ColorDescription, ColorPrimaries, Config, Context, EncoderConfig,
    EncoderStatus, FrameType, MatrixCoefficients, PixelRange, Rational, TransferCharacteristics,
    Tune,
};
use shiguredo_mp4::boxes::{Av01Box, Av1cBox, SampleEntry, UnknownBox, VisualSampleEntryFields};
use shiguredo_mp4::mux::{
    Mp4FileMuxer, Mp4FileMuxerOptions, Sample, TrackMetadata, estimate_maximum_moov_box_size,
};
use shiguredo_mp4::{BoxSize, BoxType, Decode, TrackKind, Utf8String};

use super::error::Result;
use super::{Channels, FormatError};

/// Playback rate in frames per second. It is slow enough to watch a burst of frames.
pub const FPS: u32 = 10;
/// Number of frames between key frames, at which a player can start. Each group has a new encoder, which keeps the
/// frames of the group in memory.
const GROUP_FRAMES: usize = 32;
/// AV1 quantizer index of grey movies.
const GREY_QUANTIZER: usize = 40;
/// AV1 quantizer index of colour movies. It is lower, because the conversion amplifies errors in red and blue. Noise
/// has a PSNR of 41 dB.
const COLOUR_QUANTIZER: usize = 16;
/// rav1e's fastest preset. Slower ones hardly reduce the size of noisy frames.
const SPEED: u8 = 10;
/// Start of each packet of the encoder, which MP4 omits.
const TEMPORAL_DELIMITER: &[u8] = &[0x12, 0];
/// The codes of BT.709 for primaries, transfer and matrix.
const BT709: [u16; 3] = [1; 3];

/// The description of a movie.
#[derive(Debug, Clone, Copy)]
pub struct Clip<'a> {
    /// Numbers of frames, rows and columns.
    pub shape: (usize, usize, usize),
    /// Channels of the frames.
    pub channels: Channels,
    /// Name of the video track.
    pub title: &'a str,
}

/// Writes a movie frame by frame.
pub struct MovieWriter<W> {
    output: W,
    /// Offset of the next packet.
    position: u64,
    muxer: Mp4FileMuxer,
    settings: EncoderConfig,
    encoder: Context<u8>,
    /// Number of frames of the current group.
    group_frames: usize,
    /// Description of the track. The first packet completes it.
    entry: Option<Av01Box>,
    clip: (usize, usize, usize),
    channels: Channels,
}

/// Starts a movie at the beginning of `output`, which must be empty.
///
/// Errors: I/O; [`FormatError::Internal`] for a size that can't be encoded.
pub fn writer<W: Write + Seek>(mut output: W, clip: &Clip<'_>) -> Result<MovieWriter<W>> {
    let (frames, height, width) = clip.shape;
    let settings = settings((height, width), clip.channels);
    let encoder = encoder(&settings)?;
    let muxer = Mp4FileMuxer::with_options(Mp4FileMuxerOptions {
        // The index precedes the frames, so browsers can play before the download is complete.
        reserved_moov_box_size: estimate_maximum_moov_box_size(&[frames]) + clip.title.len(),
        video_track: TrackMetadata {
            name: Utf8String::new(clip.title).unwrap_or_default(),
            ..TrackMetadata::default()
        },
        ..Mp4FileMuxerOptions::default()
    })
    .map_err(internal)?;
    let head = muxer.initial_boxes_bytes();
    output.write_all(head).map_err(FormatError::io("write the movie"))?;
    let position = head.len() as u64;
    let entry = Some(entry((height, width), &encoder)?);
    let (clip, channels) = (clip.shape, clip.channels);
    let group_frames = 0;
    Ok(MovieWriter {
        output,
        position,
        muxer,
        settings,
        encoder,
        group_frames,
        entry,
        clip,
        channels,
    })
}

impl<W: Write + Seek> MovieWriter<W> {
    /// Adds a frame \[row, column\], or \[row, 3 column\] for colours, with levels from 0 to 255.
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a frame of another size.
    pub fn write_frame(&mut self, frame: ArrayView2<'_, u8>) -> Result<()> {
        let (_, height, width) = self.clip;
        if frame.dim() != (height, width * self.channels.count()) {
            let text =
                format!("a frame {:?} does not fit a movie of {height}x{width}", frame.dim());
            return Err(FormatError::Internal(text));
        }
        if self.group_frames == GROUP_FRAMES {
            self.end_group()?;
            self.encoder = encoder(&self.settings)?;
        }
        let mut planes = self.encoder.new_frame();
        for (plane, levels) in planes.planes.iter_mut().zip(to_planes(frame, self.channels)) {
            if levels.is_empty() {
                plane.data.fill(NEUTRAL_CHROMA);
            } else {
                plane.copy_from_raw_u8(&levels, width, 1);
            }
        }
        self.encoder.send_frame(planes).map_err(internal)?;
        self.group_frames += 1;
        self.write_packets()
    }

    /// Writes the remaining packets and the index, and returns the output, positioned at its end.
    ///
    /// Errors: I/O.
    pub fn finish(mut self) -> Result<W> {
        self.end_group()?;
        let boxes = self.muxer.finalize().map_err(internal)?;
        for (offset, bytes) in boxes.offset_and_bytes_pairs() {
            let written = self
                .output
                .seek(SeekFrom::Start(offset))
                .and_then(|_| self.output.write_all(bytes));
            written.map_err(FormatError::io("write the movie"))?;
        }
        let flushed = self.output.seek(SeekFrom::End(0)).and_then(|_| self.output.flush());
        flushed.map_err(FormatError::io("write the movie"))?;
        Ok(self.output)
    }

    fn end_group(&mut self) -> Result<()> {
        self.encoder.flush();
        self.group_frames = 0;
        self.write_packets()
    }

    /// Writes the packets that the encoder has finished.
    fn write_packets(&mut self) -> Result<()> {
        loop {
            match self.encoder.receive_packet() {
                Ok(packet) => {
                    self.write_packet(&packet.data, packet.frame_type == FrameType::KEY)?;
                }
                Err(EncoderStatus::Encoded) => {}
                Err(EncoderStatus::NeedMoreData | EncoderStatus::LimitReached) => return Ok(()),
                Err(status) => return Err(internal(status)),
            }
        }
    }

    fn write_packet(&mut self, packet: &[u8], keyframe: bool) -> Result<()> {
        let data = packet.strip_prefix(TEMPORAL_DELIMITER).unwrap_or(packet);
        self.output.write_all(data).map_err(FormatError::io("write the movie"))?;
        let sample_entry = self.entry.take().map(|mut entry| {
            entry.av1c_box.config_obus = sequence_header(data).to_vec();
            SampleEntry::Av01(entry)
        });
        let sample = Sample {
            track_kind: TrackKind::Video,
            sample_entry,
            keyframe,
            timescale: NonZeroU32::MIN.saturating_add(FPS - 1),
            duration: 1,
            composition_time_offset: None,
            data_offset: self.position,
            data_size: data.len(),
        };
        self.muxer.append_sample(&sample).map_err(internal)?;
        self.position += data.len() as u64;
        Ok(())
    }
}

fn settings((height, width): (usize, usize), channels: Channels) -> EncoderConfig {
    let mut settings = EncoderConfig::with_speed_preset(SPEED);
    (settings.height, settings.width) = (height, width);
    settings.time_base = Rational::new(1, FPS.into());
    (settings.chroma_sampling, settings.quantizer) = match channels {
        Channels::Grey => (ChromaSampling::Cs420, GREY_QUANTIZER),
        Channels::Rgb => (ChromaSampling::Cs444, COLOUR_QUANTIZER),
    };
    settings.pixel_range = PixelRange::Limited;
    settings.color_description = Some(ColorDescription {
        color_primaries: ColorPrimaries::BT709,
        transfer_characteristics: TransferCharacteristics::BT709,
        matrix_coefficients: MatrixCoefficients::BT709,
    });
    settings.tune = Tune::Psnr;
    // One packet per frame, in order, without delay.
    settings.low_latency = true;
    settings.speed_settings.rdo_lookahead_frames = 1;
    settings.set_key_frame_interval(GROUP_FRAMES as u64, GROUP_FRAMES as u64);
    settings
}

fn encoder(settings: &EncoderConfig) -> Result<Context<u8>> {
    // A worker uses one core; the others are for other tasks.
    let config = Config::new().with_encoder_config(settings.clone()).with_threads(1);
    config.new_context().map_err(internal)
}

/// The description of the video track in MP4.
fn entry((height, width): (usize, usize), encoder: &Context<u8>) -> Result<Av01Box> {
    let side = |side: usize| u16::try_from(side).map_err(internal);
    let content = encoder.container_sequence_header();
    let mut av1c = (8 + content.len() as u32).to_be_bytes().to_vec();
    av1c.extend(b"av1C");
    av1c.extend(content);
    let mut colours = b"nclx".to_vec();
    colours.extend(BT709.iter().flat_map(|code| code.to_be_bytes()));
    // Limited range of levels.
    colours.push(0);
    Ok(Av01Box {
        visual: VisualSampleEntryFields {
            data_reference_index: VisualSampleEntryFields::DEFAULT_DATA_REFERENCE_INDEX,
            width: side(width)?,
            height: side(height)?,
            horizresolution: VisualSampleEntryFields::DEFAULT_HORIZRESOLUTION,
            vertresolution: VisualSampleEntryFields::DEFAULT_VERTRESOLUTION,
            frame_count: VisualSampleEntryFields::DEFAULT_FRAME_COUNT,
            compressorname: VisualSampleEntryFields::NULL_COMPRESSORNAME,
            depth: VisualSampleEntryFields::DEFAULT_DEPTH,
        },
        av1c_box: Av1cBox::decode(&av1c).map_err(internal)?.0,
        unknown_boxes: vec![UnknownBox {
            box_type: BoxType::Normal(*b"colr"),
            box_size: BoxSize::U32(8 + colours.len() as u32),
            payload: colours,
        }],
    })
}

/// The sequence header at the start of a key frame's packet: an OBU header of one byte, a length below 128 in one byte,
/// and the content.
fn sequence_header(packet: &[u8]) -> &[u8] {
    const SEQUENCE_HEADER: u8 = 0x0a;
    match packet {
        [SEQUENCE_HEADER, length @ 0..0x80, ..] => {
            packet.get(..2 + usize::from(*length)).unwrap_or_default()
        }
        _ => &[],
    }
}

/// The level of chroma planes without colour.
const NEUTRAL_CHROMA: u8 = 128;

/// Converts a frame to a luma and two chroma planes (BT.709). The chroma planes of a grey frame are empty.
fn to_planes(frame: ArrayView2<'_, u8>, channels: Channels) -> [Vec<u8>; 3] {
    let luma = |y: f32| (16.0 + 219.0 / 255.0 * y).round() as u8;
    let chroma = |c: f32| (f32::from(NEUTRAL_CHROMA) + 224.0 / 255.0 * c).round() as u8;
    match channels {
        Channels::Grey => {
            [frame.iter().map(|&level| luma(level.into())).collect(), Vec::new(), Vec::new()]
        }
        Channels::Rgb => {
            let levels: Vec<u8> = frame.iter().copied().collect();
            let mut planes = [(); 3].map(|()| Vec::with_capacity(levels.len() / 3));
            for pixel in levels.chunks_exact(3) {
                let [red, green, blue] = [0, 1, 2].map(|channel| f32::from(pixel[channel]));
                let y = 0.2126 * red + 0.7152 * green + 0.0722 * blue;
                planes[0].push(luma(y));
                planes[1].push(chroma((blue - y) / 1.8556));
                planes[2].push(chroma((red - y) / 1.5748));
            }
            planes
        }
    }
}

fn internal(error: impl std::fmt::Display) -> FormatError {
    FormatError::Internal(format!("movie: {error}"))
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use ndarray::Array2;
    use shiguredo_mp4::boxes::SampleEntry;
    use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};

    use super::{Clip, FPS, GROUP_FRAMES, to_planes, writer};
    use crate::{Channels, FormatError};

    fn movie(frames: usize, (height, width): (usize, usize), channels: Channels) -> Vec<u8> {
        let clip = Clip { shape: (frames, height, width), channels, title: "100 frames/s" };
        let mut writer = writer(Cursor::new(Vec::new()), &clip).unwrap();
        for k in 0..frames {
            let level = |(i, j): (usize, usize)| ((i * 7 + j * 3 + k * 5) % 256) as u8;
            let frame = Array2::from_shape_fn((height, width * channels.count()), level);
            writer.write_frame(frame.view()).unwrap();
        }
        writer.finish().unwrap().into_inner()
    }

    #[test]
    fn the_index_precedes_the_frames_and_is_complete() {
        // Odd sides, and more than one group.
        let frames = GROUP_FRAMES + 3;
        let bytes = movie(frames, (33, 47), Channels::Grey);
        let place = |name: &[u8]| bytes.windows(4).position(|window| window == name);
        assert!(place(b"moov") < place(b"mdat"));
        let mut demuxer = Mp4FileDemuxer::new();
        demuxer.handle_input(Input { position: 0, data: &bytes });
        let mut is_key = Vec::new();
        let mut end = 0;
        while let Some(sample) = demuxer.next_sample().unwrap() {
            assert_eq!((sample.duration, sample.track.timescale.get()), (1, FPS));
            if let Some(SampleEntry::Av01(entry)) = sample.sample_entry {
                assert_eq!((entry.visual.height, entry.visual.width), (33, 47));
                assert!(!entry.av1c_box.config_obus.is_empty());
            }
            is_key.push(sample.keyframe);
            end = sample.data_offset as usize + sample.data_size;
        }
        assert_eq!((is_key.len(), end), (frames, bytes.len()));
        let keys: Vec<_> = (0..frames).filter(|&k| is_key[k]).collect();
        assert_eq!(keys, [0, GROUP_FRAMES]);
    }

    #[test]
    fn frames_of_another_size_are_refused() {
        let clip = Clip { shape: (1, 32, 32), channels: Channels::Rgb, title: "" };
        let mut writer = writer(Cursor::new(Vec::new()), &clip).unwrap();
        let refused = writer.write_frame(Array2::zeros((32, 32)).view());
        assert!(matches!(refused, Err(FormatError::Internal(_))), "{refused:?}");
    }

    #[test]
    fn levels_follow_bt709() {
        let grey = to_planes(ndarray::array![[0, 255]].view(), Channels::Grey);
        assert_eq!(grey[0], [16, 235]);
        let pixels = ndarray::array![[255, 255, 255, 255, 0, 0, 0, 255, 0, 0, 0, 255]];
        let [luma, blue, red] = to_planes(pixels.view(), Channels::Rgb);
        // ITU-R BT.709, table 3.
        assert_eq!(luma, [235, 63, 173, 32]);
        assert_eq!(blue, [128, 102, 42, 240]);
        assert_eq!(red, [128, 240, 26, 118]);
    }
}
