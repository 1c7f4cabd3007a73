//! The head of a BigTIFF whose frames follow as they lie in memory: float32, little-endian, one strip each.
//!
//! All directories come first, so that a file of any length is this head and then raw frames. The first
//! page has two descriptions: OME-XML for those that read it, and ImageJ's lines for those that don't. The
//! `tiff` crate keeps one description a page and writes directories behind pixels, so the head is made here.

use std::fmt::Write;

use super::Channels;

/// A clip, as viewers are told of it.
#[derive(Debug, Clone, Copy)]
pub struct Clip<'a> {
    /// What it is called; any text.
    pub name: &'a str,
    /// Frames, rows, columns.
    pub shape: (usize, usize, usize),
    /// What a pixel has.
    pub channels: Channels,
    /// Seconds from the start of a frame to that of the next, if it is the same for all and known.
    pub interval_s: Option<f64>,
    /// Start of each frame in seconds, if known.
    pub times_s: Option<&'a [f64]>,
}

/// Byte order, version, size of offsets, and the place of the first directory.
const HEADER: [u8; 16] = *b"II\x2b\0\x08\0\0\0\x10\0\0\0\0\0\0\0";
const ASCII: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;
const LONG8: u16 = 16;
/// Bytes of a directory's entry.
const ENTRY: usize = 20;
/// Entries of each page.
const ENTRIES: usize = 10;
const DESCRIPTION: u16 = 270;
/// Frames begin at a multiple of this.
const ALIGNMENT: usize = 64;

/// The bytes before the first frame.
pub fn head(clip: &Clip<'_>) -> Vec<u8> {
    let (frames, height, width) = clip.shape;
    let channels = clip.channels.count();
    let mut texts = vec![ome(clip)];
    // ImageJ has no colours of floating point.
    texts.extend((clip.channels == Channels::Grey).then(|| imagej(clip)));
    let texts: Vec<_> = texts.iter().map(|text| [text.as_bytes(), b"\0"].concat()).collect();
    let directory = |entries: usize| 8 + entries * ENTRY + 8;
    let with_texts = directory(ENTRIES + texts.len());
    let behind = HEADER.len() + with_texts + frames.saturating_sub(1) * directory(ENTRIES);
    let length = (behind + texts.iter().map(Vec::len).sum::<usize>()).next_multiple_of(ALIGNMENT);
    let frame_bytes = height * width * channels * size_of::<f32>();
    // The same number for each channel, 16 bits each.
    let each = |number: usize| (0..channels).map(|channel| number << (16 * channel)).sum();
    let mut head = HEADER.to_vec();
    head.reserve_exact(length - head.len());
    for frame in 0..frames {
        let mut entries: Vec<(u16, u16, usize, usize)> = vec![
            (256, LONG, 1, width),
            (257, LONG, 1, height),
            // 32 bits a sample, not compressed, black is 0.
            (258, SHORT, channels, each(32)),
            (259, SHORT, 1, 1),
            // Grey, or red, green and blue.
            (262, SHORT, 1, if channels == 1 { 1 } else { 2 }),
            (273, LONG8, 1, length + frame * frame_bytes),
            (277, SHORT, 1, channels),
            (278, LONG, 1, height),
            (279, LONG8, 1, frame_bytes),
            // Floating point.
            (339, SHORT, channels, each(3)),
        ];
        if frame == 0 {
            let mut at = behind;
            for (index, text) in texts.iter().enumerate() {
                entries.insert(5 + index, (DESCRIPTION, ASCII, text.len(), at));
                at += text.len();
            }
        }
        head.extend((entries.len() as u64).to_le_bytes());
        for (tag, kind, count, value) in &entries {
            head.extend(tag.to_le_bytes());
            head.extend(kind.to_le_bytes());
            head.extend((*count as u64).to_le_bytes());
            // Shorter kinds take the first bytes of the field.
            head.extend((*value as u64).to_le_bytes());
        }
        let next = if frame + 1 < frames { head.len() + 8 } else { 0 };
        head.extend((next as u64).to_le_bytes());
    }
    texts.iter().for_each(|text| head.extend(text));
    head.resize(length, 0);
    head
}

/// What ImageJ writes of a stack of frames.
fn imagej(clip: &Clip<'_>) -> String {
    let frames = clip.shape.0;
    let mut text = format!(
        "ImageJ=1.54f\nimages={frames}\nframes={frames}\nhyperstack=true\nmode=grayscale\nunit=pixel\n"
    );
    if let Some(interval) = clip.interval_s {
        text += &format!("finterval={interval}\nfps={}\n", 1.0 / interval);
    }
    text += "loop=false\n";
    text
}

/// OME-XML of June 2016.
fn ome(clip: &Clip<'_>) -> String {
    let (frames, height, width) = clip.shape;
    let interval = clip.interval_s.map_or(String::new(), |seconds| {
        format!(" TimeIncrement=\"{seconds}\" TimeIncrementUnit=\"s\"")
    });
    let mut planes = String::new();
    for (frame, time) in clip.times_s.into_iter().flatten().enumerate() {
        // Writing to a text can't fail.
        let _ = write!(
            planes,
            "<Plane TheZ=\"0\" TheT=\"{frame}\" TheC=\"0\" DeltaT=\"{time}\" DeltaTUnit=\"s\"/>"
        );
    }
    let schema = "http://www.openmicroscopy.org/Schemas/OME/2016-06";
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\
         <OME xmlns=\"{schema}\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:schemaLocation=\"{schema} {schema}/ome.xsd\">\
         <Image ID=\"Image:0\" Name=\"{name}\">\
         <Pixels ID=\"Pixels:0\" DimensionOrder=\"{order}\" Type=\"float\" BigEndian=\"false\" \
         SizeX=\"{width}\" SizeY=\"{height}\" SizeZ=\"1\" SizeC=\"{channels}\" SizeT=\"{frames}\"{interval}>\
         <Channel ID=\"Channel:0:0\" SamplesPerPixel=\"{channels}\"/>\
         <TiffData IFD=\"0\" PlaneCount=\"{frames}\"/>{planes}</Pixels></Image></OME>",
        name = escaped(clip.name),
        channels = clip.channels.count(),
        // Of a page the colours come first.
        order = if clip.channels == Channels::Grey { "XYZCT" } else { "XYCZT" },
    )
}

/// A text as it may stand in an attribute of XML, in ASCII as TIFF wants it.
fn escaped(text: &str) -> String {
    let mut escaped = String::new();
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            // XML has no place for them.
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

    use super::{Channels, Clip, escaped, head};

    #[test]
    fn another_reader_finds_every_frame() {
        for channels in [Channels::Grey, Channels::Rgb] {
            read(channels);
        }
    }

    fn read(channels: Channels) {
        let (frames, height, width) = (3, 5, 7);
        let times = [0.0, 0.25, 0.5];
        let clip = Clip {
            name: "a & b",
            shape: (frames, height, width),
            channels,
            interval_s: Some(0.25),
            times_s: Some(&times),
        };
        let mut file = head(&clip);
        let count = frames * height * width * channels.count();
        let values: Vec<f32> = (0..count).map(|at| at as f32 - 7.5).collect();
        file.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let mut decoder = Decoder::new(Cursor::new(file)).unwrap();
        let mut found = Vec::new();
        for frame in 0..frames {
            assert_eq!(decoder.dimensions().unwrap(), (7, 5));
            let described = decoder.find_tag(Tag::ImageDescription).unwrap().is_some();
            assert_eq!(described, frame == 0);
            let DecodingResult::F32(values) = decoder.read_image().unwrap() else { panic!() };
            found.extend(values);
            assert_eq!(decoder.more_images(), frame + 1 < frames);
            if decoder.more_images() {
                decoder.next_image().unwrap();
            }
        }
        assert_eq!(found, values);
    }

    #[test]
    fn names_do_no_harm_to_the_xml() {
        assert_eq!(escaped("a<b>\"c\"&\u{7}é"), "a&lt;b&gt;&quot;c&quot;&amp; &#233;");
    }
}
