// Renders the contract with Redoc.

/** Removes operations that serve only the pages of the service, then paths and tags without operations. */
function publicPart(contract) {
  const tags = new Set();
  for (const [path, item] of Object.entries(contract.paths)) {
    for (const [method, operation] of Object.entries(item)) {
      if (operation["x-internal"]) delete item[method];
      else operation.tags?.forEach((tag) => tags.add(tag));
    }
    if (!Object.values(item).some((part) => part.operationId)) delete contract.paths[path];
  }
  return { ...contract, tags: contract.tags.filter(({ name }) => tags.has(name)) };
}

async function start(root) {
  const response = await fetch("openapi.json");
  if (!response.ok) throw new Error(`openapi.json: ${response.status}`);
  const options = {
    downloadUrls: [{ title: "YAML", url: "openapi.yaml" }, { title: "JSON", url: "openapi.json" }],
    hideSchemaTitles: true,
    nativeScrollbars: true,
    requiredPropsFirst: true,
    showExtensions: ["x-extensible-enum"],
  };
  globalThis.Redoc.init(publicPart(await response.json()), options, root);
}

const root = document.getElementById("reference");
start(root).catch((error) => {
  const note = document.createElement("p");
  note.setAttribute("role", "alert");
  note.textContent = `The reference can't be shown: ${error.message}. Reload the page, or read openapi.yaml.`;
  root.replaceChildren(note);
});
