//! The order of the planes of an OME-TIFF, which its OME-XML states.

use roxmltree::{Document, Node, ParsingOptions};

use super::refusal::{malformed, refused};
use crate::error::Result;

/// Largest number of nodes of a description. Each plane has a few.
const MAX_NODES: u32 = 1 << 18;

const ACCEPTED_SERIES: &str = "one image (to convert the first image: python -c \"import numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif', series=0))\")";
const ACCEPTED_PAGES: &str = "OME-XML that names each page once (to convert the pages in the order of the file: \
     python -c \"import numpy, tifffile; numpy.save('out.npy', [p.asarray() for p in \
     tifffile.TiffFile('in.tif').pages])\")";

/// The page of each plane, in the order of the planes: first the fastest of the dimensions C, Z and T. `None` if the
/// text is not OME-XML. `pages` is the number of pages with frames.
///
/// Errors: malformed XML; several images; planes in other files; pages that are missing or not described.
pub(super) fn order(text: &str, pages: usize) -> Result<Option<Vec<usize>>> {
    if !text.starts_with('<') || !text.ends_with("OME>") {
        return Ok(None);
    }
    let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options)
        .map_err(|error| malformed(format!("the OME-XML of page 0: {error}")))?;
    let root = document.root_element();
    let named =
        |name: &'static str| root.descendants().filter(move |node| node.tag_name().name() == name);
    if named("BinaryOnly").next().is_some() {
        return Err(refused(
            "an OME-TIFF with its OME-XML in another file".to_owned(),
            ACCEPTED_PAGES,
        ));
    }
    let images: Vec<Node> = named("Pixels").collect();
    let [image] = *images else {
        return match images.len() {
            0 => Ok(None),
            count => Err(refused(format!("an OME-TIFF of {count} images"), ACCEPTED_SERIES)),
        };
    };
    let planes = Planes::of(image)?;
    let own = root.attribute("UUID");
    let mut order = vec![None; pages];
    let data: Vec<Node> =
        image.children().filter(|node| node.tag_name().name() == "TiffData").collect();
    for item in &data {
        let file = item.children().find(|node| node.tag_name().name() == "UUID");
        if file
            .and_then(|file| file.text())
            .is_some_and(|file| own.is_some_and(|own| own != file.trim()))
        {
            return Err(refused(
                "an OME-TIFF with planes in other files".to_owned(),
                ACCEPTED_PAGES,
            ));
        }
        let first = planes.index(*item)?;
        let page = number(*item, "IFD", 0)?;
        let default = if item.has_attribute("IFD") { 1 } else { pages };
        for plane in 0..number(*item, "PlaneCount", default)?.min(pages + 1) {
            match order.get_mut(first.saturating_add(plane)) {
                Some(place @ None) => *place = Some(page.saturating_add(plane)),
                _ => return Err(misfit(planes.count, pages)),
            }
        }
    }
    if data.is_empty() {
        order = (0..pages).map(Some).collect();
    }
    let order: Option<Vec<usize>> = order.into_iter().collect();
    let order = order.filter(|order| {
        let mut sorted = order.clone();
        sorted.sort_unstable();
        sorted.into_iter().eq(0..planes.count)
    });
    order.ok_or_else(|| misfit(planes.count, pages)).map(Some)
}

fn misfit(planes: usize, pages: usize) -> crate::FormatError {
    refused(
        format!(
            "OME-XML that describes {planes} planes and does not fit the {pages} pages of the file"
        ),
        ACCEPTED_PAGES,
    )
}

/// The dimensions of the planes of an image, the fastest one first.
struct Planes {
    /// The attribute with the first index of each dimension, and its size.
    dimensions: Vec<(&'static str, usize)>,
    count: usize,
}

impl Planes {
    fn of(image: Node<'_, '_>) -> Result<Self> {
        let order = image.attribute("DimensionOrder").unwrap_or("XYCZT");
        let channel = image.children().find(|node| node.tag_name().name() == "Channel");
        let samples =
            channel.map_or(Ok(1), |channel| number(channel, "SamplesPerPixel", 1))?.max(1);
        let mut dimensions = Vec::new();
        for letter in order.chars().skip(2) {
            dimensions.push(match letter {
                'C' => ("FirstC", number(image, "SizeC", 1)? / samples),
                'Z' => ("FirstZ", number(image, "SizeZ", 1)?),
                'T' => ("FirstT", number(image, "SizeT", 1)?),
                _ => {
                    return Err(malformed(format!(
                        "the OME-XML has the dimension order '{}'",
                        order.escape_debug()
                    )));
                }
            });
        }
        let count = dimensions.iter().fold(1usize, |count, (_, size)| count.saturating_mul(*size));
        Ok(Self { dimensions, count })
    }

    /// The index of the first plane of a `TiffData` element.
    fn index(&self, item: Node<'_, '_>) -> Result<usize> {
        let (mut index, mut stride) = (0usize, 1usize);
        for (attribute, size) in &self.dimensions {
            let first = number(item, attribute, 0)?;
            index = index.saturating_add(first.saturating_mul(stride));
            stride = stride.saturating_mul(*size);
        }
        Ok(index)
    }
}

fn number(node: Node<'_, '_>, attribute: &str, default: usize) -> Result<usize> {
    let Some(text) = node.attribute(attribute) else { return Ok(default) };
    text.trim().parse().map_err(|_| {
        malformed(format!("{attribute} in the OME-XML is '{}', not a number", text.escape_debug()))
    })
}
