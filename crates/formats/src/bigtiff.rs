//! Writes the head of a BigTIFF, which is followed by raw frames: little-endian float32, one strip each.
//!
//! All directories precede the pixels, so a file can be streamed as this head and raw frames. The first page has two
//! descriptions: OME-XML, and ImageJ's lines for programs that do not read OME-XML. The `tiff` crate writes only one
//! description per page, and directories after the pixels.

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

/// Byte order, version, size of offsets, and offset of the first directory.
const HEADER: [u8; 16] = *b"II\x2b\0\x08\0\0\0\x10\0\0\0\0\0\0\0";
const ASCII: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;
const LONG8: u16 = 16;
/// Length of an entry of a directory, in bytes.
const ENTRY: usize = 20;
/// Number of entries of a page without descriptions.
const ENTRIES: usize = 10;
const DESCRIPTION: u16 = 270;
/// Alignment of the first frame, in bytes.
const ALIGNMENT: usize = 64;

/// Returns the bytes before the first frame.
pub fn head(clip: &Clip<'_>) -> Vec<u8> {
    let (frames, height, width) = clip.shape;
    let channels = clip.channels.count();
    let mut texts = vec![ome(clip)];
    // ImageJ does not support floating-point colours.
    texts.extend((clip.channels == Channels::Grey).then(|| imagej(clip)));
    let texts: Vec<_> = texts.iter().map(|text| [text.as_bytes(), b"\0"].concat()).collect();
    let directory = |entries: usize| 8 + entries * ENTRY + 8;
    let first_directory = directory(ENTRIES + texts.len());
    let texts_start =
        HEADER.len() + first_directory + frames.saturating_sub(1) * directory(ENTRIES);
    let length =
        (texts_start + texts.iter().map(Vec::len).sum::<usize>()).next_multiple_of(ALIGNMENT);
    let frame_bytes = height * width * channels * size_of::<f32>();
    // Repeats a 16-bit number for each channel.
    let for_each_channel =
        |number: usize| (0..channels).map(|channel| number << (16 * channel)).sum();
    let mut head = HEADER.to_vec();
    head.reserve_exact(length - head.len());
    for frame in 0..frames {
        let mut entries: Vec<(u16, u16, usize, usize)> = vec![
            (256, LONG, 1, width),
            (257, LONG, 1, height),
            // 32 bits per sample, not compressed.
            (258, SHORT, channels, for_each_channel(32)),
            (259, SHORT, 1, 1),
            // BlackIsZero, or RGB.
            (262, SHORT, 1, if channels == 1 { 1 } else { 2 }),
            (273, LONG8, 1, length + frame * frame_bytes),
            (277, SHORT, 1, channels),
            (278, LONG, 1, height),
            (279, LONG8, 1, frame_bytes),
            // Floating point.
            (339, SHORT, channels, for_each_channel(3)),
        ];
        if frame == 0 {
            let mut offset = texts_start;
            for (index, text) in texts.iter().enumerate() {
                entries.insert(5 + index, (DESCRIPTION, ASCII, text.len(), offset));
                offset += text.len();
            }
        }
        head.extend((entries.len() as u64).to_le_bytes());
        for (tag, kind, count, value) in &entries {
            head.extend(tag.to_le_bytes());
            head.extend(kind.to_le_bytes());
            head.extend((*count as u64).to_le_bytes());
            // Shorter types use the first bytes of the field.
            head.extend((*value as u64).to_le_bytes());
        }
        let next = if frame + 1 < frames { head.len() + 8 } else { 0 };
        head.extend((next as u64).to_le_bytes());
    }
    texts.iter().for_each(|text| head.extend(text));
    head.resize(length, 0);
    head
}

/// The description of a stack in the format of ImageJ.
fn imagej(clip: &Clip<'_>) -> String {
    let images = clip.shape.0;
    let channels = clip.bands.map_or(1, |bands| bands.count.max(1));
    let frames = images / channels;
    let bands = clip.bands.map_or(String::new(), |_| format!("channels={channels}\n"));
    let mut text = format!(
        "ImageJ=1.54f\nimages={images}\n{bands}frames={frames}\nhyperstack=true\nmode=grayscale\nunit=pixel\n"
    );
    if let Some(interval) = clip.interval_s {
        text += &format!("finterval={interval}\nfps={}\n", 1.0 / interval);
    }
    text += "loop=false\n";
    text
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

    use super::{Bands, Channels, Clip, escape_xml, head};

    #[test]
    fn the_tiff_crate_reads_all_frames() {
        for channels in [Channels::Grey, Channels::Rgb] {
            assert_readable(channels);
        }
    }

    fn assert_readable(channels: Channels) {
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
        let mut file = head(&clip);
        let count = frames * height * width * channels.count();
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
        assert!(text.contains("channels=2\nframes=2\n"));
    }

    #[test]
    fn names_are_escaped_in_the_xml() {
        assert_eq!(escape_xml("a<b>\"c\"&\u{7}é"), "a&lt;b&gt;&quot;c&quot;&amp; &#233;");
    }
}
