//! Holds the architecture: who may know whom, and no circles of imports between files.
//!
//! The sources are parsed. A file depends on the files that define what its `use` lines and its
//! paths name; re-exports are followed. Test code does not count, nor do the lines in which a
//! folder's `mod.rs` lists its children (`mod x;`, `pub use x::Y;`).

#![allow(clippy::unwrap_used)] // helpers of tests

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::Visit;

/// The sources of both crates. The service hands on the core's modules, so that `crate::recon` is one
/// path in either.
const SOURCES: [&str; 2] = ["src", "core/src"];

/// Each folder of the sources, and the others that it may know.
const LAYERS: &[(&str, &[&str])] = &[
    ("formats", &[]),
    ("optics", &["formats"]),
    ("recon", &[]),
    ("job", &["recon", "optics", "formats"]),
    ("intake", &["optics", "formats", "job"]),
    ("pipeline", &["recon", "optics", "formats", "job"]),
    ("store", &["job", "formats"]),
    ("worker", &["store", "pipeline", "intake", "job", "formats", "recon", "optics"]),
    ("cluster", &["worker", "store", "pipeline", "job", "formats", "recon"]),
    ("http", &["store", "pipeline", "intake", "job", "formats", "config"]),
];

/// Crates and modules that only these files and folders may name.
const OWNERS: &[(&str, &[&str])] = &[
    ("ort", &["core/src/recon/prior/onnx.rs"]),
    ("sqlx", &["src/store/", "core/src/job/columns.rs"]),
    ("axum", &["src/http/", "src/cli/serve.rs"]),
    ("tokio", &["src/http/", "src/store/", "src/worker/", "src/cluster/", "src/cli/"]),
    ("async_nats", &["src/cluster/"]),
    ("crate::cluster", &["src/cluster/", "src/cli/"]),
    ("crate::http", &["src/http/", "src/cli/serve.rs"]),
];

/// Folders that know arrays and no files.
const WITHOUT_FILES: (&[&str], &[&str], &[&str]) = (
    &["core/src/recon/", "core/src/optics/"],
    &["std::fs", "std::path"],
    &["core/src/recon/prior/onnx.rs"],
);

/// A module's path from the crate's root.
type Module = Vec<String>;

/// What a file of the sources says of itself and of others.
#[derive(Default)]
struct File {
    place: String,
    /// Whether it is a folder's own file, which lists children.
    is_folder: bool,
    children: BTreeSet<String>,
    /// What it imports: the name here, and the path it stands for.
    imports: BTreeMap<String, Vec<String>>,
    /// Paths of ours that it depends on.
    uses: BTreeSet<Vec<String>>,
    /// All other paths that it names, such as `std::fs::File`.
    foreign: BTreeSet<String>,
}

struct Reader {
    module: Module,
    file: File,
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Meta>().is_ok_and(|meta| meta.path().is_ident("test"))
    })
}

impl Reader {
    /// The path from the crate's root; none for a path of another crate or a local name.
    fn absolute(&self, path: &[String]) -> Option<Vec<String>> {
        let mut base = self.module.clone();
        let mut rest = path;
        match path.first()?.as_str() {
            "crate" => return Some(path[1..].to_vec()),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|word| word == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            first if self.file.children.contains(first) => {}
            _ => return None,
        }
        base.extend_from_slice(rest);
        Some(base)
    }

    fn tree(&mut self, tree: &syn::UseTree, prefix: &[String], public: bool) {
        let with = |name: &dyn ToString| [prefix, &[name.to_string()]].concat();
        match tree {
            syn::UseTree::Path(path) => self.tree(&path.tree, &with(&path.ident), public),
            syn::UseTree::Group(group) => {
                group.items.iter().for_each(|item| self.tree(item, prefix, public));
            }
            syn::UseTree::Name(name) if name.ident == "self" => {
                let shown = prefix.last().cloned().unwrap_or_default();
                self.import(prefix, shown, public);
            }
            syn::UseTree::Name(name) => {
                self.import(&with(&name.ident), name.ident.to_string(), public);
            }
            syn::UseTree::Rename(name) => {
                self.import(&with(&name.ident), name.rename.to_string(), public);
            }
            syn::UseTree::Glob(_) => self.import(&with(&"*"), "*".into(), public),
        }
    }

    fn import(&mut self, path: &[String], shown: String, public: bool) {
        let Some(absolute) = self.absolute(path) else {
            self.file.foreign.insert(path.join("::"));
            return;
        };
        let of_child = absolute.len() > self.module.len() && absolute.starts_with(&self.module);
        if !(public && of_child && self.file.is_folder) {
            self.file.uses.insert(absolute.clone());
        }
        self.file.imports.insert(shown, absolute);
    }
}

impl<'ast> Visit<'ast> for Reader {
    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'ast syn::ItemImpl) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_impl(self, item);
        }
    }

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        if !is_test(&item.attrs) {
            let public = !matches!(item.vis, syn::Visibility::Inherited);
            self.tree(&item.tree, &[], public);
        }
    }

    /// `pub(in path)` is no dependency.
    fn visit_visibility(&mut self, _: &'ast syn::Visibility) {}

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let words: Vec<String> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        if words.len() > 1 {
            match self.absolute(&words) {
                Some(path) => self.file.uses.insert(path),
                None => self.file.foreign.insert(words.join("::")),
            };
        }
        syn::visit::visit_path(self, path);
    }
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

fn read(text: &str, module: Module, place: &str, is_folder: bool) -> File {
    let tree = syn::parse_file(text).unwrap_or_else(|error| panic!("{place}: {error}"));
    let child = |item: &syn::Item| match item {
        syn::Item::Mod(item) if item.content.is_none() => Some(item.ident.to_string()),
        _ => None,
    };
    let children = tree.items.iter().filter_map(child).collect();
    let file = File { place: place.into(), is_folder, children, ..File::default() };
    let mut reader = Reader { module, file };
    reader.visit_file(&tree);
    reader.file
}

/// All files of the library; those that hold nothing but tests are left out.
fn read_all() -> BTreeMap<Module, File> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    let paths = SOURCES.into_iter().flat_map(|folder| {
        let mut paths = Vec::new();
        sources(&root.join(folder), &mut paths);
        paths.into_iter().map(move |path| (folder, path))
    });
    for (folder, path) in paths {
        let within = path.strip_prefix(root.join(folder)).unwrap().with_extension("");
        let mut module: Module =
            within.iter().map(|word| word.to_string_lossy().into_owned()).collect();
        let tests = |word: &String| word == "tests" || word == "test_support";
        let of_core = folder != "src";
        if (of_core && module[0] == "lib")
            || module[0] == "main"
            || module[0] == "bin"
            || module.iter().any(tests)
        {
            continue;
        }
        let listing = module.last().is_some_and(|name| name == "mod" || name == "lib");
        if listing {
            module.pop();
        }
        let place = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
        let text = fs::read_to_string(&path).unwrap();
        let is_folder = listing || path.with_extension("").is_dir();
        files.insert(module.clone(), read(&text, module, &place, is_folder));
    }
    files
}

/// The module whose file defines what a path from the root names.
fn definer(files: &BTreeMap<Module, File>, path: &[String], depth: usize) -> Option<Module> {
    let mut module = Module::new();
    for (index, word) in path.iter().enumerate() {
        let child = [module.as_slice(), std::slice::from_ref(word)].concat();
        if files.contains_key(&child) {
            module = child;
            continue;
        }
        return match files.get(&module)?.imports.get(word) {
            Some(target) if depth > 0 => {
                definer(files, &[target.as_slice(), &path[index + 1..]].concat(), depth - 1)
            }
            _ => Some(module),
        };
    }
    Some(module)
}

/// The files that each file depends on.
fn dependencies(files: &BTreeMap<Module, File>) -> BTreeMap<Module, BTreeSet<Module>> {
    let of = |(module, file): (&Module, &File)| {
        let targets = file.uses.iter().filter_map(|path| definer(files, path, 8));
        (module.clone(), targets.filter(|target| target != module).collect())
    };
    files.iter().map(of).collect()
}

/// The files that can be reached from one.
fn ahead(edges: &BTreeMap<Module, BTreeSet<Module>>, from: &Module) -> BTreeSet<Module> {
    let mut seen = BTreeSet::new();
    let mut open = vec![from];
    while let Some(at) = open.pop() {
        open.extend(edges[at].iter().filter(|next| seen.insert((*next).clone())));
    }
    seen
}

/// Sets of files each of which depends on all others of its set.
fn circles(edges: &BTreeMap<Module, BTreeSet<Module>>) -> BTreeSet<BTreeSet<Module>> {
    let reached: BTreeMap<&Module, BTreeSet<Module>> =
        edges.keys().map(|module| (module, ahead(edges, module))).collect();
    let circle = |module: &Module| {
        let others = &reached[module];
        others.iter().filter(|other| reached[other].contains(module)).cloned().collect()
    };
    edges.keys().filter(|module| reached[*module].contains(*module)).map(circle).collect()
}

#[test]
fn no_files_depend_on_each_other_in_a_circle() {
    let edges = dependencies(&read_all());
    let mut text = String::new();
    for circle in circles(&edges) {
        text += &format!("\na circle of {} files:\n", circle.len());
        for module in &circle {
            let next: Vec<String> =
                edges[module].intersection(&circle).map(|other| other.join("::")).collect();
            text += &format!("    {} -> {}\n", module.join("::"), next.join(", "));
        }
    }
    assert!(text.is_empty(), "{text}");
}

#[test]
fn folders_know_only_what_they_may() {
    let files = read_all();
    let mut broken = Vec::new();
    for (module, file) in &files {
        let of = |(name, _): &&(&str, _)| module.first().is_some_and(|top| top == name);
        let Some((folder, may)) = LAYERS.iter().find(of) else { continue };
        // By the names that are written down: `job` hands on the schedule of `recon`.
        let foreign = |path: &&Vec<String>| path.first().is_some_and(|top| top != folder);
        for path in file.uses.iter().filter(foreign) {
            if !may.contains(&path[0].as_str()) {
                broken.push(format!("{}: {folder} must not know {}", file.place, path.join("::")));
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn crates_are_known_where_they_belong() {
    let starts = |path: &str, root: &str| {
        path.strip_prefix(root).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
    };
    let mut broken = Vec::new();
    for file in read_all().values() {
        let named = |root: &str| {
            let of_ours = file.uses.iter().map(|path| format!("crate::{}", path.join("::")));
            file.foreign.iter().cloned().chain(of_ours).any(|path| starts(&path, root))
        };
        let within = |places: &[&str]| places.iter().any(|place| file.place.starts_with(place));
        for (root, owners) in OWNERS {
            if !within(owners) && named(root) {
                broken.push(format!("{} must not know {root}", file.place));
            }
        }
        let (folders, roots, exceptions) = WITHOUT_FILES;
        for root in roots {
            if within(folders) && !within(exceptions) && named(root) {
                broken.push(format!("{} must not know {root}", file.place));
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn the_check_sees_what_it_should() {
    let module = |path: &str| path.split("::").map(str::to_owned).collect::<Module>();
    let file = |path: &str, text: &str, is_folder| {
        (module(path), read(text, module(path), path, is_folder))
    };
    let files = BTreeMap::from([
        (Module::new(), read("mod a;", Module::new(), "lib", true)),
        file("a", "mod b; mod c; mod d; pub use b::Thing;", true),
        // By a name that the folder exports, and by a path inside an expression.
        file("a::b", "fn f() { super::c::g(); } pub struct Thing;", false),
        file("a::c", "use crate::a::{Thing, d::{self, h}};", false),
        file("a::d", "use std::fs; #[cfg(test)] mod tests { use super::super::c; }", false),
    ]);
    let edges = dependencies(&files);
    assert_eq!(edges[&module("a::c")], BTreeSet::from([module("a::b"), module("a::d")]));
    assert_eq!(edges[&module("a")], BTreeSet::new());
    let circle = BTreeSet::from([module("a::b"), module("a::c")]);
    assert_eq!(circles(&edges), BTreeSet::from([circle]));
    assert!(files[&module("a::d")].foreign.contains("std::fs"));
}
