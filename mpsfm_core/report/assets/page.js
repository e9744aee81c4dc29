"use strict";
// Builds the page from the data in it. All texts go in as text nodes: names may be anything.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { photos, pairs } = data;
  const byId = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";

  function el(tag, attributes = {}, ...children) {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) {
      if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
      else if (value !== null && value !== undefined && value !== false) node.setAttribute(key, value);
    }
    node.append(...children.filter((child) => child !== null && child !== undefined));
    return node;
  }

  const number = (value, digits = 0) =>
    value === null || value === undefined ? "–" : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  const percent = (share, digits = 0) => (share === null || share === undefined ? "–" : `${number(100 * share, digits)} %`);
  const time = (seconds) =>
    seconds < 10 ? `${number(seconds, 1)} s` : seconds < 120 ? `${number(seconds)} s` : seconds < 7200 ? `${number(seconds / 60, 1)} min` : `${number(seconds / 3600, 1)} h`;
  const plural = (count, thing, things = `${thing}s`) => `${number(count)} ${count === 1 ? thing : things}`;
  const STATUS = { registered: "has its place", unconfirmed: "placed without proof", missing: "missing" };
  const STATUS_COLOR = { registered: "#1f9d6b", unconfirmed: "#c98a10", missing: "#d0453b" };

  // Who matches whom: for each photo its verified partners, most matches first.
  const partners = photos.map(() => []);
  for (const pair of pairs) {
    const [a, b, , inliers] = pair;
    if (!inliers) continue;
    partners[a].push({ other: b, pair });
    partners[b].push({ other: a, pair });
  }
  for (const list of partners) list.sort((x, y) => y.pair[3] - x.pair[3]);

  // ---------------------------------------------------------------- overview
  function overview() {
    byId("folder").textContent = data.folder;
    const level = data.verdict.level;
    byId("badge").textContent = { good: "complete", partial: "partial", failed: "failed" }[level];
    byId("badge").classList.add(level);
    byId("verdict").textContent = data.verdict.text;
    const best = data.reconstructions[0];
    const total = Object.values(data.stages).reduce((sum, seconds) => sum + seconds, 0);
    const verified = pairs.filter((pair) => pair[3] > 0).length;
    const tiles = [
      ["Photos", `${photos.filter((photo) => photo.status === "registered").length} of ${photos.length}`, null],
      ["Matching pairs", `${number(verified)} of ${number(pairs.length)}`, "verified of compared"],
    ];
    if (best) {
      tiles.push(
        ["Points", number(best.points), `seen by ${number(best.mean_track_length, 1)} photos each`],
        ["Reprojection error", best.mean_reprojection_error_px === null ? "–" : `${number(best.mean_reprojection_error_px, 2)} px`, "mean"],
        ["Refined depth std", percent(best.median_relative_depth_std, 1), "median, relative to depth"],
        ["Scale", ...data.scales[0]],
      );
    }
    if (data.frames.length) {
      const sizes = data.frames.map((frame) => frame.photos.length);
      tiles.push(["Frames of the rig", number(data.frames.length), `${Math.max(...sizes)} photos each, such as the views of a panorama; one pose a frame`]);
    }
    tiles.push(["Time", time(total), data.memory_mb ? `${number(data.memory_mb / 1024, 1)} GB memory at most` : null]);
    for (const [label, value, hint] of tiles)
      byId("figures").append(el("div", {}, el("dt", {}, label), el("dd", {}, value, hint && el("small", {}, hint))));
    for (const finding of data.findings) {
      const names = el("div", { class: "names" });
      for (const name of finding.images.slice(0, 8)) {
        const row = photos.findIndex((photo) => photo.name === name);
        names.append(el("button", { class: "chip", onclick: () => select(row, true) }, name));
      }
      if (finding.images.length > 8) names.append(el("span", { class: "hint" }, `and ${finding.images.length - 8} more`));
      byId("findings").append(
        el("div", { class: `finding ${finding.level}` }, el("h3", {}, finding.title), el("p", {}, finding.text),
          finding.remedy && el("p", { class: "do" }, el("b", {}, "What to do: "), finding.remedy),
          finding.images.length > 0 && finding.images.length < photos.length ? names : null),
      );
    }
  }

  // ---------------------------------------------------------------- one photo
  const MAPS = [["photo", "Photo"], ["prior", "Prior"], ["refined", "Refined"], ["std", "Std"], ["normals", "Normals"]];
  let selected = -1;
  let shownMap = "photo";
  const listeners = [];

  function select(row, scroll = false) {
    selected = row;
    for (const listener of listeners) listener(row);
    if (scroll) byId("view").scrollIntoView();
  }

  function showPhoto(row) {
    const aside = byId("photo");
    aside.replaceChildren();
    if (row < 0) {
      aside.append(el("p", { class: "hint" }, "Click a camera, a photo below, a row of the table or a line of the match graph."));
      return;
    }
    const photo = photos[row];
    const look = el("div", { class: "look" });
    const know = el("div");
    aside.append(el("div", {}, el("h3", {}, photo.name), el("div", { class: `status ${photo.status}` }, STATUS[photo.status]), look), know);
    if (photo.explanation)
      look.append(el("div", { class: "why" }, el("p", {}, photo.explanation), el("p", { class: "hint" }, photo.remedy)));
    const there = MAPS.filter(([key]) => photo.pictures[key]);
    if (there.length) {
      if (!photo.pictures[shownMap]) shownMap = there[0][0];
      const image = el("img", { class: "main", onclick: () => enlarge(row, shownMap) });
      const legend = el("div", { class: "hint" });
      const tabs = el("div", { class: "tabs", role: "tablist" });
      const show = (key) => {
        shownMap = key;
        image.src = photo.pictures[key].src;
        image.alt = `${key} of ${photo.name}`;
        legend.textContent = photo.pictures[key].legend || "";
        for (const tab of tabs.children) tab.setAttribute("aria-selected", String(tab.dataset.map === key));
      };
      for (const [key, label] of there)
        tabs.append(el("button", { role: "tab", "data-map": key, onclick: () => show(key) }, label));
      look.append(tabs, image, legend);
      show(shownMap);
    }
    const facts = [
      ["Keypoints", number(photo.keypoints)], ["Points", number(photo.points)],
      ["Error", photo.error === null ? "–" : `${number(photo.error, 2)} px`], ["Prior depth std", percent(photo.depth_std, 1)],
      ["Focal length", `${number(photo.refined_focal ?? photo.focal)} px`], ["from", photo.refined_focal ? `${photo.focal_from}, refined` : photo.focal_from],
    ];
    const frame = data.frames.find(({ photos: rows }) => rows.includes(photos.indexOf(photo)));
    if (frame) facts.push(["Frame", frame.name], ["Frame position", [3, 7, 11].map((i) => number(frame.pose[i], 2)).join(", ")]);
    if (photo.rendering) facts.push(...renderingFacts(photo.rendering));
    for (const [name, value, std, digits] of photo.lens) facts.push([name, `${number(value, digits)} ± ${number(std, digits)}`]);
    know.append(el("dl", { class: "small" }, ...facts.map(([k, v]) => el("div", {}, el("dt", {}, k), el("dd", {}, v)))));
    know.append(el("h4", {}, partners[row].length ? `Matches with ${plural(partners[row].length, "photo")}` : "Matches no other photo"));
    const chips = el("div", { class: "names" });
    const place = el("div", { class: "pair" });
    for (const { other, pair } of partners[row].slice(0, 24))
      chips.append(
        el("button", { class: "chip", title: photos[other].name, onclick: (event) => {
          for (const chip of chips.children) chip.classList.toggle("on", chip === event.currentTarget);
          const canvas = pairCanvas(row, other, 800);
          canvas.addEventListener("click", () => enlargePair(row, other));
          place.replaceChildren(canvas);
        } }, shorten(photos[other].name), el("small", {}, number(pair[3]))),
      );
    know.append(chips, place);
    if (chips.firstChild) chips.firstChild.click();
    aside.scrollTop = 0;
  }

  const shorten = (name) => (name.length > 22 ? `…${name.slice(-21)}` : name);

  function enlarge(row, map) {
    const { name, pictures } = photos[row];
    openLarge(el("p", {}, `${name}: ${map}`), el("img", { src: pictures[map].src, alt: map }));
  }

  function enlargePair(a, b) {
    const pair = pairs.find(([x, y]) => (x === a && y === b) || (x === b && y === a));
    const text = pair[3] ? `${plural(pair[3], "verified match", "verified matches")} of ${number(pair[2])} found` : `${number(pair[2])} matches found, none kept`;
    openLarge(el("p", {}, `${photos[a].name} and ${photos[b].name}: ${text}${pair[4] ? ` (${pair[4]})` : ""}`), pairCanvas(a, b, 1500));
  }

  function openLarge(...content) {
    byId("largest").replaceChildren(...content);
    byId("large").showModal();
  }

  // Both photos side by side with lines between what was matched.
  function pairCanvas(a, b, width) {
    const canvas = el("canvas", { width, height: Math.round(width * 0.38), "aria-label": `matches of ${photos[a].name} and ${photos[b].name}` });
    const flipped = data.lines[`${a} ${b}`] === undefined;
    const encoded = data.lines[`${a} ${b}`] ?? data.lines[`${b} ${a}`];
    const lines = encoded ? new Uint16Array(bytes(encoded).buffer) : new Uint16Array(0);
    Promise.all([a, b].map((row) => picture(row))).then((images) => {
      const gap = Math.round(width / 100);
      const half = (width - gap) / 2;
      const heights = images.map((image) => (image ? (half * image.naturalHeight) / image.naturalWidth : half * 0.7));
      canvas.height = Math.round(Math.max(...heights));
      const context = canvas.getContext("2d");
      images.forEach((image, side) => {
        if (image) context.drawImage(image, side * (half + gap), 0, half, heights[side]);
      });
      context.lineWidth = Math.max(1, width / 700);
      for (let i = 0; i < lines.length; i += 4) {
        const ends = [[lines[i], lines[i + 1]], [lines[i + 2], lines[i + 3]]];
        if (flipped) ends.reverse();
        const points = ends.map(([x, y], side) => [side * (half + gap) + (x / 65535) * half, (y / 65535) * heights[side]]);
        context.strokeStyle = context.fillStyle = `hsl(${(360 * points[0][1]) / heights[0]} 85% 58% / .75)`;
        context.beginPath();
        context.moveTo(...points[0]);
        context.lineTo(...points[1]);
        context.stroke();
        for (const [x, y] of points) context.fillRect(x - context.lineWidth, y - context.lineWidth, 2 * context.lineWidth, 2 * context.lineWidth);
      }
      canvas.dataset.lines = String(lines.length / 4);
    });
    return canvas;
  }

  function picture(row) {
    const source = photos[row].pictures.photo;
    if (!source) return Promise.resolve(null);
    return new Promise((resolve) => {
      const image = new Image();
      image.onload = () => resolve(image);
      image.onerror = () => resolve(null);
      image.src = source.src;
    });
  }

  function strip() {
    photos.forEach((photo, row) => {
      const source = photo.pictures.photo;
      byId("strip").append(
        el("button", { class: photo.status, title: photo.name, "data-row": row, onclick: () => select(row) },
          source ? el("img", { src: source.src, alt: photo.name, loading: "lazy" }) : el("span", {}, shorten(photo.name))),
      );
    });
    listeners.push((row) => {
      for (const button of byId("strip").children) button.classList.toggle("on", Number(button.dataset.row) === row);
    });
  }

  // How well would a held-out photo have been predicted? Uncovered photos have no PSNR.
  function renderingFacts({ geometry, covered, psnr, ssim }) {
    const value = psnr === null ? "–" : `${number(psnr, 1)} dB, SSIM ${number(ssim, 2)}`;
    return [["Held out, predicted by", geometry], ["Covered", percent(covered)], ["PSNR of the prediction", value]];
  }

  // ---------------------------------------------------------------- table
  const COLUMNS = [
    ["Photo", (p) => p.name, null],
    ["State", (p) => ["registered", "unconfirmed", "missing"].indexOf(p.status), (p) => STATUS[p.status]],
    ["Partners", (p) => p.partners, (p) => number(p.partners)],
    ["Keypoints", (p) => p.keypoints, (p) => number(p.keypoints)],
    ["Points", (p) => p.points, (p) => number(p.points)],
    ["Error px", (p) => p.error, (p) => number(p.error, 2)],
    ["Prior depth std", (p) => p.depth_std, (p) => percent(p.depth_std, 1)],
    ["Valid depth", (p) => p.valid_depth, (p) => percent(p.valid_depth)],
    ["Focal px", (p) => p.refined_focal ?? p.focal, (p) => number(p.refined_focal ?? p.focal)],
  ];

  function table() {
    const body = el("tbody");
    const rows = photos.map((photo, row) => {
      const cells = COLUMNS.map(([, , format], column) => {
        if (column === 0) {
          const source = photo.pictures.photo;
          return el("td", {}, source ? el("img", { class: "thumb", src: source.src, alt: "", loading: "lazy" }) : null, photo.name);
        }
        const cell = el("td", { class: column > 1 ? "number" : null }, format(photo));
        if (column === 1) cell.style.color = STATUS_COLOR[photo.status];
        return cell;
      });
      return el("tr", { "data-row": row, onclick: () => select(row, true) }, ...cells);
    });
    const heads = COLUMNS.map(([label, key], column) => {
      const head = el("th", { class: column > 1 ? "number" : null, "aria-sort": "none" });
      head.append(el("button", { onclick: () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        for (const other of heads) other.setAttribute("aria-sort", "none");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const value = (tr) => key(photos[Number(tr.dataset.row)]);
        const order = (x, y) => (typeof x === "string" ? x.localeCompare(y, "en", { numeric: true }) : (x ?? Infinity) - (y ?? Infinity));
        rows.sort((x, y) => (down ? -1 : 1) * order(value(x), value(y)));
        body.append(...rows);
      } }, label));
      return head;
    });
    byId("table").append(el("thead", {}, el("tr", {}, ...heads)), body);
    body.append(...rows);
    listeners.push((row) => {
      for (const tr of rows) tr.classList.toggle("on", Number(tr.dataset.row) === row);
    });
  }

  // ---------------------------------------------------------------- matches
  const MOST_DRAWN = 1500;

  // Names of the photos without extension and, where they are long, without what all begin with.
  function shortNames(most) {
    const bare = photos.map((photo) => photo.name.replace(/\.[^.]*$/, ""));
    let shared = 0;
    if (bare.some((name) => name.length > most))
      while (bare.every((name) => shared < name.length && name[shared] === bare[0][shared])) shared++;
    while (shared > 0 && /\d/.test(bare[0][shared - 1])) shared--; // numbers stay whole
    return bare.map((name) => name.slice(shared)).map((name) => (name.length > most ? `…${name.slice(1 - most)}` : name));
  }

  function graph() {
    const svg = byId("graph");
    const size = 500;
    svg.setAttribute("viewBox", `0 0 ${size} ${size}`);
    const draw = (tag, attributes, parent) => {
      const node = document.createElementNS(SVG, tag);
      for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
      parent.append(node);
      return node;
    };
    const around = photos.map((_, row) => {
      const angle = (2 * Math.PI * row) / photos.length - Math.PI / 2;
      return [size / 2 + 0.37 * size * Math.cos(angle), size / 2 + 0.37 * size * Math.sin(angle), angle];
    });
    const edges = pairs.filter((pair) => pair[3] > 0).sort((x, y) => y[3] - x[3]).slice(0, MOST_DRAWN);
    const most = Math.max(1, ...edges.map((edge) => edge[3]));
    const drawn = edges.reverse().map((edge) => {
      const [a, b, , inliers] = edge;
      const strength = Math.sqrt(inliers / most);
      const line = draw("line", { x1: around[a][0], y1: around[a][1], x2: around[b][0], y2: around[b][1], stroke: "var(--accent)", "stroke-width": 0.6 + 5 * strength, "stroke-opacity": 0.15 + 0.6 * strength }, svg);
      line.addEventListener("click", () => enlargePair(a, b));
      draw("title", {}, line).textContent = `${photos[a].name} – ${photos[b].name}: ${inliers} matches`;
      return [line, a, b];
    });
    const radius = Math.max(2.5, Math.min(9, 180 / photos.length));
    const labels = shortNames(9);
    const dots = photos.map((photo, row) => {
      const group = draw("g", {}, svg);
      group.addEventListener("click", () => select(row, true));
      const dot = draw("circle", { cx: around[row][0], cy: around[row][1], r: radius, fill: STATUS_COLOR[photo.status], stroke: "var(--card)", "stroke-width": 1.5 }, group);
      draw("title", {}, group).textContent = photo.name;
      if (photos.length <= 60) {
        const [x, y, angle] = around[row];
        const left = Math.cos(angle) < -0.01;
        const turn = (angle * 180) / Math.PI + (left ? 180 : 0);
        const [tx, ty] = [x + (radius + 4) * Math.cos(angle), y + (radius + 4) * Math.sin(angle)];
        const text = draw("text", { x: tx, y: ty, "text-anchor": left ? "end" : "start", "dominant-baseline": "middle", transform: `rotate(${turn} ${tx} ${ty})` }, group);
        text.textContent = labels[row];
      }
      return dot;
    });
    listeners.push((row) => {
      dots.forEach((dot, other) => dot.setAttribute("stroke", other === row ? "var(--text)" : "var(--card)"));
      for (const [line, a, b] of drawn) line.setAttribute("stroke", row >= 0 && (a === row || b === row) ? "#e8833a" : "var(--accent)");
    });
  }

  function matrix() {
    const canvas = byId("matrix");
    const count = photos.length;
    const cell = Math.max(1, Math.floor(900 / count));
    canvas.width = canvas.height = cell * count;
    const context = canvas.getContext("2d");
    const at = new Map();
    const most = Math.max(1, ...pairs.map((pair) => pair[3]));
    context.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--bg");
    context.fillRect(0, 0, canvas.width, canvas.height);
    for (let row = 0; row < count; row++) {
      context.fillStyle = STATUS_COLOR[photos[row].status];
      context.fillRect(row * cell, row * cell, cell, cell);
    }
    const inset = cell > 8 ? 1 : 0;
    for (const pair of pairs) {
      const [a, b, , inliers] = pair;
      at.set(a * count + b, pair).set(b * count + a, pair);
      context.fillStyle = inliers ? css(viridis(0.15 + 0.85 * Math.sqrt(inliers / most))) : "rgb(128 128 128 / .13)";
      for (const [x, y] of [[a, b], [b, a]]) context.fillRect(x * cell + inset, y * cell + inset, cell - 2 * inset, cell - 2 * inset);
    }
    const found = (event) => {
      const box = canvas.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top].map((v) => Math.min(count - 1, Math.max(0, Math.floor((v / box.width) * count))));
      return [x, y, at.get(x * count + y)];
    };
    const usual = byId("cell").textContent;
    canvas.addEventListener("mousemove", (event) => {
      const [x, y, pair] = found(event);
      const names = `${photos[y].name} – ${photos[x].name}`;
      if (x === y) byId("cell").textContent = `${photos[x].name}: ${STATUS[photos[x].status]}`;
      else if (!pair) byId("cell").textContent = `${names}: not compared`;
      else byId("cell").textContent = pair[3] ? `${names}: ${number(pair[3])} verified of ${number(pair[2])}${pair[4] ? `; ${pair[4]}` : ""}` : `${names}: ${pair[4]}`;
    });
    canvas.addEventListener("mouseleave", () => { byId("cell").textContent = usual; });
    canvas.addEventListener("click", (event) => {
      const [x, y, pair] = found(event);
      if (x === y) select(x, true);
      else if (pair) enlargePair(y, x);
    });
  }

  // ---------------------------------------------------------------- method
  const PALETTE = ["#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#76b7b2", "#b07aa1", "#edc948", "#9c755f", "#ff9da7", "#8c8c8c"];

  function timeBar(title, times) {
    const total = Object.values(times).reduce((sum, seconds) => sum + seconds, 0);
    if (!total) return;
    const bar = el("div", { class: "bar" });
    const key = el("div", { class: "key" });
    Object.entries(times).forEach(([name, seconds], index) => {
      const piece = el("i", { title: `${name}: ${time(seconds)}` });
      piece.style.flexGrow = String(seconds);
      piece.style.background = PALETTE[index % PALETTE.length];
      bar.append(piece);
      const dot = el("i");
      dot.style.background = PALETTE[index % PALETTE.length];
      key.append(el("span", {}, dot, `${name} `, el("small", {}, `${time(seconds)}, ${percent(seconds / total)}`)));
    });
    byId("time").append(el("div", { class: "hint" }, `${title}, ${time(total)}`), bar, key);
  }

  function method() {
    timeBar("The run", data.stages);
    timeBar("Steps of the mapping", data.steps);
    const head = ["For", "Provider", "From", "Why", "Licence of code", "of weights", "Ran", "Time"];
    const body = data.providers.map((provider) => {
      const runs = provider.computed === undefined ? "with depth" : `${number(provider.computed)}${provider.from_cache ? ` + ${number(provider.from_cache)} kept` : ""}`;
      const name = [provider.name, ...provider.wrappers].join(" in ");
      const why = [provider.chosen, provider.accuracy && `to expect: ${provider.accuracy}`].filter(Boolean).join("; ");
      const cells = [provider.block, name, provider.from, why, provider.code_license, provider.weights_license, runs, provider.seconds === undefined ? "–" : time(provider.seconds)];
      return el("tr", {}, ...cells.map((text, column) => el("td", { class: column === 3 ? "text" : null }, text)));
    });
    byId("providers").append(el("thead", {}, el("tr", {}, ...head.map((text) => el("th", {}, text)))), el("tbody", {}, ...body));
    const focals = new Map();
    for (const photo of photos) {
      const refined = photo.refined_focal ? ` refined to ${number(photo.refined_focal, 1)} px` : "";
      const text = `${number(photo.focal, 1)} px from ${photo.focal_from}${refined}`;
      focals.set(text, (focals.get(text) ?? 0) + 1);
    }
    const lines = [...focals].slice(0, 12).map(([text, count]) => `Focal length ${text} (${plural(count, "photo")})`);
    if (focals.size > 12) lines.push(`and ${focals.size - 12} further focal lengths`);
    data.reconstructions.forEach((best, index) => {
      const [unit, source] = data.scales[index];
      lines.push(`${index ? `Reconstruction components/${index}` : "Reconstruction"}: ${plural(best.images, "photo")}, ${plural(best.points, "point")}, scale: ${unit} (${source})`);
    });
    byId("cameras").append(...lines.map((text) => el("li", {}, text)));
    byId("config").textContent = data.config;
    byId("versions").textContent = Object.entries(data.versions).map(([name, version]) => `${name} ${version}`).join(" · ");
  }

  // ---------------------------------------------------------------- colours
  function bytes(text) {
    const raw = atob(text);
    const found = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) found[i] = raw.charCodeAt(i);
    return found;
  }

  const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
  function viridis(share) {
    const place = Math.min(1, Math.max(0, share)) * (VIRIDIS.length - 1);
    const low = Math.min(VIRIDIS.length - 2, Math.floor(place));
    return VIRIDIS[low].map((value, i) => value + (place - low) * (VIRIDIS[low + 1][i] - value));
  }
  const css = (rgb) => `rgb(${rgb.map(Math.round).join(" ")})`;

  // ---------------------------------------------------------------- 3D
  const VIDEO_COLOR = "#c2479f";
  const COLORS = [["photo", "photo"], ["error", "error"], ["std", "std of depth"], ["views", "number of views"]];

  function view3d() {
    const placed = photos.map((photo, row) => ({ photo, row })).filter(({ photo }) => photo.pose);
    const clouds = Object.entries(data.points).filter(([, cloud]) => cloud.count);
    if (!placed.length) return explainNo3d("Nothing was reconstructed, so there is nothing to see in 3D. The photos, their priors and their matches are below.");
    let renderer;
    try {
      renderer = new THREE.WebGLRenderer({ canvas: byId("scene"), antialias: true, preserveDrawingBuffer: true });
    } catch {
      return explainNo3d("This browser has no WebGL, so there is no 3D view. Everything else works.");
    }
    renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    const canvas = renderer.domElement;
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
    const up = new THREE.Vector3(...data.up);
    camera.up.copy(up);
    const controls = new THREE.OrbitControls(camera, canvas);
    controls.zoomToCursor = true;
    let waiting = false;
    const draw = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; renderer.render(scene, camera); });
    };
    controls.addEventListener("change", draw);

    // Points: positions, and one colour attribute that is filled anew for each way of colouring.
    const objects = {};
    const positions = ({ xyz, low, step }) => Float32Array.from(new Uint16Array(bytes(xyz).buffer), (value, i) => low[i % 3] + step[i % 3] * value);
    for (const [name, cloud] of clouds) {
      const xyz = positions(cloud);
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
      geometry.setAttribute("tint", new THREE.BufferAttribute(new Uint8Array(xyz.length), 3, true));
      const material = new THREE.ShaderMaterial({
        uniforms: { size: { value: 1 }, least: { value: name === "sparse" ? 2.5 : 1.2 } },
        vertexShader: "attribute vec3 tint; varying vec3 color; uniform float size, least; void main() { color = tint; vec4 at = modelViewMatrix * vec4(position, 1.0); gl_Position = projectionMatrix * at; gl_PointSize = clamp(size / -at.z, least, 14.0); }",
        fragmentShader: "varying vec3 color; void main() { gl_FragColor = vec4(color, 1.0); }",
      });
      const points = new THREE.Points(geometry, material);
      points.userData = { cloud, xyz, rgb: bytes(cloud.rgb) };
      objects[name] = points;
      scene.add(points);
    }

    // The mesh with its texture, whose rows start at the top.
    const loader = new THREE.TextureLoader();
    let surface = null;
    if (data.mesh) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(positions(data.mesh), 3));
      geometry.setAttribute("uv", new THREE.BufferAttribute(new Uint16Array(bytes(data.mesh.uv).buffer), 2, true));
      geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(data.mesh.triangles).buffer), 1));
      const map = loader.load(data.mesh.texture, draw);
      map.flipY = false;
      map.colorSpace = THREE.SRGBColorSpace;
      surface = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ map, side: THREE.DoubleSide }));
      scene.add(surface);
    }

    // How large things are: cameras and points, without the outermost.
    const centers = placed.map(({ photo: { pose } }) => new THREE.Vector3(pose[3], pose[7], pose[11]));
    const median = (values) => values.sort((x, y) => x - y)[Math.floor(values.length / 2)] ?? 0;
    const sample = [];
    for (const points of Object.values(objects)) {
      const { xyz } = points.userData;
      const stride = 3 * Math.max(1, Math.floor(xyz.length / 9000));
      for (let i = 0; i + 2 < xyz.length; i += stride) sample.push(new THREE.Vector3(xyz[i], xyz[i + 1], xyz[i + 2]));
    }
    const all = sample.length ? sample : centers;
    const target = new THREE.Vector3(...["x", "y", "z"].map((axis) => median(all.map((p) => p[axis]))));
    const radius = Math.max(1e-6, [...all, ...centers].map((p) => p.distanceTo(target)).sort((x, y) => x - y)[Math.floor(0.8 * (all.length + centers.length - 1))]);
    const apart = median(centers.map((p, i) => Math.min(...centers.map((q, j) => (i === j ? Infinity : p.distanceTo(q))))).filter(Number.isFinite));
    const frustum = Math.min(0.16 * radius, Math.max(0.04 * radius, 0.45 * (apart || radius)));
    camera.near = radius / 500;
    camera.far = radius * 100;

    const geometryOf = (positions) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions.flat()), 3));
      return geometry;
    };
    const pyramid = (corners) => geometryOf(corners.flatMap((corner, i) => [[0, 0, 0], corner, corner, corners[(i + 1) % 4]]));
    const cornersOf = ({ edges: [l, t, r, b] }) => [[l, t, 1], [r, t, 1], [r, b, 1], [l, b, 1]];

    // Cameras: a pyramid of lines and the photo on its base.
    const cameras = placed.map(({ photo, row }) => {
      const { pose } = photo;
      const group = new THREE.Group();
      const corners = cornersOf(photo).map(([x, y, z]) => [0, 4, 8].map((i) => pose[i] * x + pose[i + 1] * y + pose[i + 2] * z));
      const lines = new THREE.LineSegments(pyramid(corners), new THREE.LineBasicMaterial());
      const face = geometryOf([0, 1, 2, 0, 2, 3].map((i) => corners[i]));
      face.setAttribute("uv", new THREE.BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0]), 2));
      const material = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, transparent: true, opacity: 0.85 });
      if (photo.pictures.photo && !photo.pictures.photo.linked) {
        material.map = loader.load(photo.pictures.photo.src, draw);
        material.map.colorSpace = THREE.SRGBColorSpace;
      } else material.color.set("#8899aa");
      const mesh = new THREE.Mesh(face, material);
      mesh.userData.row = row;
      group.add(lines, mesh);
      group.position.set(pose[3], pose[7], pose[11]);
      scene.add(group);
      return { group, lines, mesh, row };
    });

    // Frames of rigs: an octahedron around the origin of the rig, for a panorama its center.
    const tips = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]].map((tip) => tip.map((x) => 0.3 * x));
    const diamond = geometryOf(tips.flatMap((tip, i) => [tip, tips[(i + 1) % 4], tip, [0, 0, 0.3], tip, [0, 0, -0.3]]));
    const diamonds = data.frames.map(({ pose }) => {
      const lines = new THREE.LineSegments(diamond, new THREE.LineBasicMaterial({ color: "#4a7fd4" }));
      lines.position.set(pose[3], pose[7], pose[11]);
      scene.add(lines);
      return lines;
    });

    // Videos: the path of the camera without gaps, and the camera at the time of a slider.
    const videos = data.trajectories.filter(({ times }) => times.length > 1).map((video) => {
      const { name, times, poses } = video;
      const step = median(times.slice(1).map((end, i) => end - times[i]));
      const centerAt = (i) => [3, 7, 11].map((k) => poses[i][k]);
      const path = times.slice(1).flatMap((end, i) => (end - times[i] > 5 * step ? [] : [centerAt(i), centerAt(i + 1)]));
      scene.add(new THREE.LineSegments(geometryOf(path), new THREE.LineBasicMaterial({ color: VIDEO_COLOR })));
      const { photo } = placed.find(({ photo }) => photo.name.startsWith(`${name}/`)) ?? placed[0];
      const lines = new THREE.LineSegments(pyramid(cornersOf(photo)), new THREE.LineBasicMaterial({ color: VIDEO_COLOR }));
      lines.matrixAutoUpdate = false;
      scene.add(lines);
      return { ...video, lines, shown: 0 };
    });
    const moveVideo = ({ lines, poses, shown }) => {
      const size = 1.5 * frustum * state.camera;
      lines.matrix.set(...poses[shown].map((value, i) => (i % 4 === 3 ? value : size * value)), 0, 0, 0, 1);
      lines.matrixWorldNeedsUpdate = true;
    };

    // To the photos that the selected one matches.
    const links = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: "#e8833a", transparent: true, opacity: 0.7 }));
    scene.add(links);
    const centerOf = new Map(placed.map(({ row }, i) => [row, centers[i]]));
    listeners.push((row) => {
      for (const { lines, row: own } of cameras) lines.material.color.set(own === row ? "#ff7a1a" : STATUS_COLOR[photos[own].status]);
      const from = centerOf.get(row);
      const ends = from ? partners[row].map(({ other }) => centerOf.get(other)).filter(Boolean).flatMap((to) => [...from.toArray(), ...to.toArray()]) : [];
      links.geometry.dispose();
      links.geometry = geometryOf(ends);
      draw();
    });

    const state = { shown: surface ? "mesh" : objects.dense ? "dense" : "sparse", colour: "photo", point: 1, camera: 1, photos: true };
    const paint = () => {
      const legend = byId("legend");
      legend.hidden = state.colour === "photo" || state.shown === "mesh";
      if (surface) surface.visible = state.shown === "mesh";
      for (const [name, points] of Object.entries(objects)) {
        points.visible = state.shown === "both" || state.shown === name;
        const { cloud, rgb } = points.userData;
        const tint = points.geometry.attributes.tint;
        if (state.colour === "photo") tint.array.set(rgb);
        else {
          const steps = (points.userData[state.colour] ??= bytes(cloud.values[state.colour].bytes));
          const colors = Array.from({ length: 256 }, (_, step) => (step === 255 ? [128, 128, 128] : viridis(step / 254)));
          for (let i = 0; i < cloud.count; i++) tint.array.set(colors[steps[i]], 3 * i);
        }
        tint.needsUpdate = true;
        points.material.uniforms.size.value = state.point * (name === "sparse" ? 0.008 : 0.005) * radius * canvas.clientHeight;
      }
      if (!legend.hidden) {
        const shown = objects[state.shown === "both" ? "dense" : state.shown] ?? Object.values(objects)[0];
        const { low, high, unit } = shown.userData.cloud.values[state.colour];
        const digits = state.colour === "views" ? 0 : unit === "px" ? 2 : 1;
        const what = { error: unit === "px" ? "reprojection error" : "disagreement of depth maps", std: "std of depth, of the most certain map", views: "photos that see it" }[state.colour];
        const ramp = el("i");
        ramp.style.background = `linear-gradient(90deg, ${VIRIDIS.map(css).join(",")})`;
        legend.replaceChildren(what, ramp, el("span", {}, el("b", {}, `${number(low, digits)} ${unit}`), el("b", {}, `${number(high, digits)} ${unit}`)));
      }
      for (const { group, mesh } of cameras) {
        group.scale.setScalar(frustum * state.camera);
        mesh.visible = state.photos;
      }
      videos.forEach(moveVideo);
      for (const lines of diamonds) lines.scale.setScalar(frustum * state.camera);
      draw();
    };

    // An overview: from the side of the cameras and above, at the distance at which 95 % of the points
    // and all cameras are visible. Far points do not count.
    function reset() {
      const mean = centers.reduce((sum, p) => sum.add(p), new THREE.Vector3()).divideScalar(centers.length);
      const horizontal = (vector) => vector.addScaledVector(up, -vector.dot(up));
      let back = horizontal(mean.sub(target));
      if (back.length() < 1e-3 * radius) back = horizontal(new THREE.Vector3(1, 0.3, 0.2));
      back.normalize().addScaledVector(up, 0.8).normalize();
      const right = new THREE.Vector3().crossVectors(up, back).normalize();
      const above = new THREE.Vector3().crossVectors(back, right);
      const vertical = Math.tan((camera.fov * Math.PI) / 360);
      const distance = (p) => {
        const local = p.clone().sub(target);
        return local.dot(back) + Math.max(Math.abs(local.dot(above)) / vertical, Math.abs(local.dot(right)) / (vertical * camera.aspect));
      };
      const far = all.map(distance).sort((x, y) => x - y)[Math.floor(0.95 * (all.length - 1))];
      const needed = Math.max(far, ...centers.map((p) => distance(p) + 2 * frustum));
      camera.position.copy(target).addScaledVector(back, 1.05 * needed);
      controls.target.copy(target);
      controls.update();
      draw();
    }

    function lookThrough(row) {
      const { pose } = photos[row];
      const at = centerOf.get(row);
      const forward = new THREE.Vector3(pose[2], pose[6], pose[10]);
      camera.position.copy(at).addScaledVector(forward, -1.2 * frustum * state.camera);
      controls.target.copy(at).addScaledVector(forward, Math.max(target.distanceTo(at), 2 * frustum));
      controls.update();
      draw();
    }

    const choice = (options, key) => {
      const box = el("div", { role: "group" });
      for (const option of options)
        box.append(el("button", { "aria-pressed": String(state[key] === option), onclick: (event) => {
          state[key] = option;
          for (const button of box.children) button.setAttribute("aria-pressed", String(button === event.currentTarget));
          paint();
        } }, option));
      return box;
    };
    const slider = (label, key) =>
      el("div", {}, el("label", {}, `${label} `, el("input", { type: "range", min: -1.5, max: 1.5, step: 0.05, value: 0, oninput: (event) => {
        state[key] = 10 ** (Number(event.target.value) / 2);
        paint();
      } })));
    const timeline = (video) => {
      const { name, times } = video;
      const shownTime = el("output", {}, time(times[0]));
      return el("div", {}, el("label", {}, `${shorten(name || "video")} `, el("input", { type: "range", class: "video", min: 0, max: times.length - 1, value: 0, oninput: (event) => {
        video.shown = Number(event.target.value);
        shownTime.textContent = time(times[video.shown]);
        moveVideo(video);
        draw();
      } }), shownTime));
    };
    const colour = el("select", { id: "colour", onchange: (event) => { state.colour = event.target.value; paint(); } }, ...COLORS.map(([value, label]) => el("option", { value }, label)));
    const through = el("button", { disabled: "", onclick: () => lookThrough(selected) }, "look through");
    listeners.push((row) => { through.disabled = !centerOf.has(row); });
    const shapes = [surface && "mesh", objects.dense && "dense", objects.sparse && "sparse", objects.dense && objects.sparse && "both"].filter(Boolean);
    byId("tools").append(
      shapes.length > 1 ? choice(shapes, "shown") : "",
      el("div", {}, el("label", { for: "colour" }, "colour by"), colour),
      slider("points", "point"), slider("cameras", "camera"), ...videos.map(timeline),
      el("div", {}, el("button", { "aria-pressed": "true", onclick: (event) => {
        state.photos = !state.photos;
        event.currentTarget.setAttribute("aria-pressed", String(state.photos));
        paint();
      } }, "photos"), through, el("button", { onclick: reset }, "reset view")),
    );

    // A click that is no drag selects the camera under it.
    const ray = new THREE.Raycaster();
    const under = (event) => {
      const box = canvas.getBoundingClientRect();
      const place = new THREE.Vector2(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
      ray.setFromCamera(place, camera);
      const hits = ray.intersectObjects(cameras.map(({ mesh }) => mesh), false);
      return hits.length ? hits[0].object.userData.row : -1;
    };
    let pressed = null;
    canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
    canvas.addEventListener("pointerup", (event) => {
      if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) return;
      const row = under(event);
      if (row >= 0) select(row);
    });
    canvas.addEventListener("pointermove", (event) => canvas.classList.toggle("over", !event.buttons && under(event) >= 0));

    const fit = () => {
      const { clientWidth: width, clientHeight: height } = canvas.parentElement;
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      paint();
    };
    const background = () => {
      scene.background = new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue("--stage").trim());
      draw();
    };
    new ResizeObserver(fit).observe(canvas.parentElement);
    themes.push(background);
    background();
    fit();
    reset();
    // For tests and for the curious: where the base of a camera's frustum is on the screen.
    window.report = {
      screenOf: (row) => {
        const { mesh, group } = cameras.find((own) => own.row === row);
        mesh.geometry.computeBoundingSphere();
        group.updateMatrixWorld();
        const at = mesh.geometry.boundingSphere.center.clone().applyMatrix4(group.matrixWorld).project(camera);
        const box = canvas.getBoundingClientRect();
        return [box.left + ((at.x + 1) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height];
      },
    };
  }

  function explainNo3d(text) {
    byId("no3d").textContent = text;
    byId("no3d").hidden = false;
    document.querySelector(".viewer").classList.add("flat");
  }

  // ---------------------------------------------------------------- all of it
  const themes = [];
  byId("theme").addEventListener("click", () => {
    const dark = getComputedStyle(document.documentElement).colorScheme === "dark";
    document.documentElement.dataset.theme = dark ? "light" : "dark";
    for (const change of themes) change();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => themes.forEach((change) => change()));
  byId("large").addEventListener("click", (event) => {
    if (event.target === byId("large") || event.target.className === "close") byId("large").close();
  });
  listeners.push(showPhoto);
  overview();
  strip();
  table();
  graph();
  matrix();
  method();
  view3d();
  const missing = photos.findIndex((photo) => photo.status === "missing");
  select(missing >= 0 && data.verdict.level === "failed" ? missing : 0);
})();
