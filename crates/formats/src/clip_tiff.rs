//! Writes the head of a TIFF of a clip, which is followed by raw frames: little-endian float32, one strip each.
//!
//! All directories precede the pixels, so a file can be streamed as this head and raw frames; the `tiff` crate writes
//! directories after the pixels. Files below 4 GiB are classic TIFF, which more programs read than BigTIFF. The first page
//! is described in OME-XML.

use std::fmt::Write;

use super::Channels;

/// The description of a clip for viewers.
#[derive(Debug, Clone, Copy)]
pub struct Clip<'a> {
    /// Name of the clip; any text.
    pub name: &'a str,
    /// Numbers of frames, rows and columns.
    pub shape: (usize, usize, usize),
    /// Channels of the frames.
    pub channels: Channels,
    /// Interval between the starts of frames in seconds, if it is known and constant.
    pub interval_s: Option<f64>,
    /// Start of each frame in seconds, if known.
    pub times_s: Option<&'a [f64]>,
    /// The bands of a spectral image, for frames that are its bands. The frames of several images follow one another.
    pub bands: Option<Bands<'a>>,
}

/// The bands of a spectral image.
#[derive(Debug, Clone, Copy)]
pub struct Bands<'a> {
    /// Number of bands.
    pub count: usize,
    /// Wavelength of each band in nanometres, if known.
    pub wavelengths_nm: Option<&'a [f64]>,
}

const ASCII: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;
const LONG8: u16 = 16;
/// Number of entries of a page without a description.
const ENTRIES: usize = 10;
const DESCRIPTION: u16 = 270;
/// Alignment of the first frame, in bytes.
const ALIGNMENT: usize = 64;

/// A kind of TIFF.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Classic,
    Big,
}

impl Kind {
    /// Byte order, version, and offset of the first directory.
    fn header(self) -> &'static [u8] {
        match self {
            Self::Classic => b"II\x2a\0\x08\0\0\0",
            Self::Big => b"II\x2b\0\x08\0\0\0\x10\0\0\0\0\0\0\0",
        }
    }

    /// Length of an offset, and of the count and value of an entry, in bytes.
    fn offset(self) -> usize {
        if self == Self::Classic { 4 } else { 8 }
    }

    /// Length of the number of entries of a directory, in bytes.
    fn count(self) -> usize {
        if self == Self::Classic { 2 } else { 8 }
    }

    /// Length of a directory, in bytes.
    fn directory(self, entries: usize) -> usize {
        self.count() + entries * (4 + 2 * self.offset()) + self.offset()
    }

    /// The type of offsets and lengths of frames.
    fn long(self) -> u16 {
        if self == Self::Classic { LONG } else { LONG8 }
    }
}

/// Returns the bytes before the first frame.
pub fn head(clip: &Clip<'_>) -> Vec<u8> {
    let (frames, height, width) = clip.shape;
    let frame_bytes = height * width * clip.channels.count() * size_of::<f32>();
    let classic = head_of(Kind::Classic, clip, frame_bytes);
    if u32::try_from(classic.len() + frames * frame_bytes).is_ok() {
        return classic;
    }
    head_of(Kind::Big, clip, frame_bytes)
}

#[allow(clippy::cast_possible_truncation)] // The caller takes the kind whose offsets hold the file.
fn head_of(kind: Kind, clip: &Clip<'_>, frame_bytes: usize) -> Vec<u8> {
    let (frames, height, width) = clip.shape;
    let channels = clip.channels.count();
    let text = [ome(clip).as_bytes(), b"\0"].concat();
    // Numbers for each channel do not fit into an entry of a classic TIFF.
    let first_directory = kind.header().len();
    let other_directories = first_directory + kind.directory(ENTRIES + 1);
    let sample_sizes = other_directories + frames.saturating_sub(1) * kind.directory(ENTRIES);
    let sample_formats = sample_sizes + channels * size_of::<u16>();
    let text_start = sample_formats + channels * size_of::<u16>();
    let length = (text_start + text.len()).next_multiple_of(ALIGNMENT);
    let for_each_channel = |number: u16, place: usize| match channels {
        1 => usize::from(number),
        _ if kind == Kind::Classic => place,
        _ => (0..channels).map(|channel| usize::from(number) << (16 * channel)).sum(),
    };
    let put = |head: &mut Vec<u8>, number: usize, bytes: usize| {
        head.extend(&(number as u64).to_le_bytes()[..bytes]);
    };
    let mut head = kind.header().to_vec();
    head.reserve_exact(length - head.len());
    for frame in 0..frames {
        let mut entries: Vec<(u16, u16, usize, usize)> = vec![
            (256, LONG, 1, width),
            (257, LONG, 1, height),
            // 32 bits per sample, not compressed.
            (258, SHORT, channels, for_each_channel(32, sample_sizes)),
            (259, SHORT, 1, 1),
            // BlackIsZero, or RGB.
            (262, SHORT, 1, if channels == 1 { 1 } else { 2 }),
            (273, kind.long(), 1, length + frame * frame_bytes),
            (277, SHORT, 1, channels),
            (278, LONG, 1, height),
            (279, kind.long(), 1, frame_bytes),
            // Floating point.
            (339, SHORT, channels, for_each_channel(3, sample_formats)),
        ];
        if frame == 0 {
            entries.insert(5, (DESCRIPTION, ASCII, text.len(), text_start));
        }
        put(&mut head, entries.len(), kind.count());
        for (tag, field, count, value) in &entries {
            head.extend(tag.to_le_bytes());
            head.extend(field.to_le_bytes());
            put(&mut head, *count, kind.offset());
            // Shorter types use the first bytes of the field.
            put(&mut head, *value, kind.offset());
        }
        let next = if frame + 1 < frames { head.len() + kind.offset() } else { 0 };
        put(&mut head, next, kind.offset());
    }
    for number in [32_u16, 3] {
        (0..channels).for_each(|_| head.extend(number.to_le_bytes()));
    }
    head.extend(text);
    head.resize(length, 0);
    head
}

/// The description of a stack in OME-XML (schema of June 2016).
fn ome(clip: &Clip<'_>) -> String {
    let (frames, height, width) = clip.shape;
    let interval = clip.interval_s.map_or(String::new(), |seconds| {
        format!(" TimeIncrement=\"{seconds}\" TimeIncrementUnit=\"s\"")
    });
    let mut planes = String::new();
    for (frame, time) in clip.times_s.into_iter().flatten().enumerate() {
        // Writing to a string can't fail.
        let _ = write!(
            planes,
            "<Plane TheZ=\"0\" TheT=\"{frame}\" TheC=\"0\" DeltaT=\"{time}\" DeltaTUnit=\"s\"/>"
        );
    }
    let bands = clip.bands.map_or(1, |bands| bands.count.max(1));
    let channels = clip.channels.count();
    let mut channel_list = String::new();
    for band in 0..bands {
        let wavelengths = clip.bands.and_then(|bands| bands.wavelengths_nm);
        let wavelength = wavelengths.and_then(|lengths| lengths.get(band));
        let named = wavelength.map_or(String::new(), |nm| {
            format!(" Name=\"{nm} nm\" EmissionWavelength=\"{nm}\" EmissionWavelengthUnit=\"nm\"")
        });
        let _ = write!(
            channel_list,
            "<Channel ID=\"Channel:0:{band}\"{named} SamplesPerPixel=\"{channels}\"/>"
        );
    }
    let schema = "http://www.openmicroscopy.org/Schemas/OME/2016-06";
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\
         <OME xmlns=\"{schema}\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:schemaLocation=\"{schema} {schema}/ome.xsd\">\
         <Image ID=\"Image:0\" Name=\"{name}\">\
         <Pixels ID=\"Pixels:0\" DimensionOrder=\"{order}\" Type=\"float\" BigEndian=\"false\" \
         SizeX=\"{width}\" SizeY=\"{height}\" SizeZ=\"1\" SizeC=\"{size_c}\" SizeT=\"{size_t}\"{interval}>{channel_list}\
         <TiffData IFD=\"0\" PlaneCount=\"{frames}\"/>{planes}</Pixels></Image></OME>",
        name = escape_xml(clip.name),
        size_c = bands * channels,
        size_t = frames / bands,
        // The channels of a page are interleaved, so they vary first.
        order =
            if clip.channels == Channels::Grey && clip.bands.is_none() { "XYZCT" } else { "XYCZT" },
    )
}

/// Escapes a text for an XML attribute, in ASCII as TIFF requires.
fn escape_xml(text: &str) -> String {
    let mut escaped = String::new();
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            // XML does not allow control characters.
            control if control.is_control() => escaped.push(' '),
            ascii if ascii.is_ascii() => escaped.push(ascii),
            other => {
                let _ = write!(escaped, "&#{};", u32::from(other));
            }
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use tiff::decoder::{Decoder, DecodingResult};
    use tiff::tags::Tag;

    use super::{Bands, Channels, Clip, Kind, escape_xml, head, head_of};

    #[test]
    fn the_tiff_crate_reads_all_frames() {
        for channels in [Channels::Grey, Channels::Rgb] {
            for kind in [Kind::Classic, Kind::Big] {
                assert_readable(kind, channels);
            }
        }
    }

    #[test]
    fn files_above_4_gib_are_big() {
        let clip = |frames| Clip {
            name: "",
            shape: (frames, 1024, 1024),
            channels: Channels::Grey,
            interval_s: None,
            times_s: None,
            bands: None,
        };
        assert_eq!(head(&clip(1023))[2], 0x2a);
        assert_eq!(head(&clip(1024))[2], 0x2b);
    }

    fn assert_readable(kind: Kind, channels: Channels) {
        let (frames, height, width) = (3, 5, 7);
        let times = [0.0, 0.25, 0.5];
        let clip = Clip {
            name: "a & b",
            shape: (frames, height, width),
            channels,
            interval_s: Some(0.25),
            times_s: Some(&times),
            bands: None,
        };
        let count = frames * height * width * channels.count();
        let mut file = head_of(kind, &clip, 4 * count / frames);
        let values: Vec<f32> = (0..count).map(|at| at as f32 - 7.5).collect();
        file.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let mut decoder = Decoder::new(Cursor::new(file)).unwrap();
        let mut decoded = Vec::new();
        for frame in 0..frames {
            assert_eq!(decoder.dimensions().unwrap(), (7, 5));
            let described = decoder.find_tag(Tag::ImageDescription).unwrap().is_some();
            assert_eq!(described, frame == 0);
            let DecodingResult::F32(values) = decoder.read_image().unwrap() else { panic!() };
            decoded.extend(values);
            assert_eq!(decoder.more_images(), frame + 1 < frames);
            if decoder.more_images() {
                decoder.next_image().unwrap();
            }
        }
        assert_eq!(decoded, values);
    }

    #[test]
    fn bands_are_channels_with_their_wavelengths() {
        let wavelengths_nm = Some(&[450.0, 460.5][..]);
        let clip = Clip {
            name: "a",
            shape: (4, 5, 7),
            channels: Channels::Grey,
            interval_s: None,
            times_s: None,
            bands: Some(Bands { count: 2, wavelengths_nm }),
        };
        let text = String::from_utf8_lossy(&head(&clip)).into_owned();
        assert!(text.contains("SizeC=\"2\" SizeT=\"2\"") && text.contains("\"XYCZT\""), "{text}");
        assert!(text.contains("ID=\"Channel:0:1\" Name=\"460.5 nm\" EmissionWavelength=\"460.5\""));
    }

    #[test]
    fn names_are_escaped_in_the_xml() {
        assert_eq!(escape_xml("a<b>\"c\"&\u{7}é"), "a&lt;b&gt;&quot;c&quot;&amp; &#233;");
    }
}
