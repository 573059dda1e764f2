"use strict";
/* Shows openapi.json: each path with its parameters and the keys of its answer. */

function element(kind, text, attributes = {}) {
  const made = document.createElement(kind);
  if (text) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

const nameOf = (schema) => (schema.$ref ? schema.$ref.split("/").pop() : "");
const follow = (all, schema) => (schema.$ref ? all[nameOf(schema)] : schema);

function kindOf(schema) {
  if (schema.$ref) return nameOf(schema);
  if (schema.anyOf) return schema.anyOf.map(kindOf).join(" or ");
  const kinds = [schema.type || "any"].flat().join(" or ");
  return schema.items ? `${kinds} of ${kindOf(schema.items)}` : kinds;
}

function rowsOf(properties) {
  const made = element("table"), body = element("tbody"), head = element("tr");
  for (const text of ["Key", "Type", "Meaning"]) head.append(element("th", text, { scope: "col" }));
  const top = element("thead");
  top.append(head);
  for (const [key, schema] of Object.entries(properties)) {
    const line = element("tr");
    [["Key", key], ["Type", kindOf(schema)], ["Meaning", [schema.description, (schema.enum || []).join(", ")].filter(Boolean).join(" ") || "–"]]
      .forEach(([label, text]) => {
        const cell = element("td", "", { "data-label": label });
        cell.append(element("span", text));
        line.append(cell);
      });
    body.append(line);
  }
  made.append(top, body);
  return made;
}

async function show() {
  const description = await (await fetch("openapi.json", { cache: "no-store" })).json();
  const all = description.components.schemas;
  document.getElementById("about").textContent = description.info.description;
  const place = document.getElementById("paths");
  for (const [path, { get }] of Object.entries(description.paths)) {
    const section = element("section");
    section.append(element("h2", `GET ${path}`), element("p", get.summary));
    for (const one of get.parameters) {
      const { minimum, maximum, default: usual } = one.schema;
      const bounds = [minimum !== undefined && `from ${minimum}`, maximum !== undefined && `to ${maximum}`, usual !== undefined && `default ${usual}`].filter(Boolean).join(", ");
      section.append(element("p", `?${one.name}= ${one.description} (${bounds})`, { class: "quiet" }));
    }
    section.append(rowsOf(follow(all, get.responses["200"].content["application/json"].schema).properties));
    place.append(section);
  }
  const section = element("section");
  section.append(element("h2", "Window"), rowsOf(all.Window.properties), element("h2", "Finding"), rowsOf(all.Finding.properties));
  place.append(section);
}

show();
