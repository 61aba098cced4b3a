import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import {
  accessible,
  changes,
  chartPicture,
  chooseEndlessJob,
  chooseExample,
  expect,
  openPage,
  reaches,
  seen,
  showsSurface,
  submit,
  surfacePicture,
  test,
} from "./fixtures";

const FIXTURES = join(import.meta.dirname, "../../../tests/fixtures");

test("an example is submitted, watched while it shrinks, and its result turned, pointed at and downloaded", async ({ page, service }) => {
  await openPage(page, service);
  await accessible(page);
  const ball = await seen(surfacePicture(page));
  await chooseExample(page, "Snowman");
  const id = await submit(page);
  await expect(page).toHaveURL(new RegExp(`#/jobs/${id}$`));
  // fronts of mesh events are drawn, one after the other
  await expect(page.locator(".viewer")).toHaveAttribute("data-fronts", /[1-9]/);
  await changes(surfacePicture(page), ball);
  await showsSurface(page);
  await accessible(page);
  const still = await seen(surfacePicture(page));

  const box = (await surfacePicture(page).boundingBox())!;
  const middle = [box.x + box.width / 2, box.y + box.height / 2] as const;
  await page.mouse.move(...middle);
  await page.mouse.down();
  await page.mouse.move(middle[0] + 90, middle[1] + 30, { steps: 4 });
  await page.mouse.up();
  await page.mouse.move(5, 5);
  const dragged = await changes(surfacePicture(page), still);
  await page.getByRole("application", { name: /Surface in space/ }).focus();
  await page.keyboard.press("ArrowLeft");
  const turned = await changes(surfacePicture(page), dragged);
  await page.keyboard.press("+");
  const larger = await changes(surfacePicture(page), turned);
  await page.getByRole("button", { name: "Reset view" }).click();
  await changes(surfacePicture(page), larger);

  const job = (await (await fetch(`${service.api}/v1/jobs/${id}`)).json()) as { outputs: { name: string; href: string; sha256: string }[] };
  for (const output of job.outputs) {
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator(".outputs").getByRole("link", { name: output.name }).click()]);
    const saved = readFileSync(await download.path());
    const served = Buffer.from(await (await fetch(service.api + output.href)).arrayBuffer());
    expect(saved.equals(served)).toBe(true);
    expect(createHash("sha256").update(saved).digest("hex")).toBe(output.sha256);
  }
  expect(job.outputs.map((output) => output.name).sort()).toEqual(["glb", "preview", "report", "surface"]);
  await expect(page.locator(".recent").getByRole("link", { name: "snowman" }).first()).toBeVisible();

  // the way back leads to the ball
  await page.goBack();
  await expect(page.getByRole("heading", { name: "From a sphere to a surface" })).toBeVisible();
});

test("every mode shows something else, in space and in the square", async ({ page, service }) => {
  // distances that the tests know: a ramp over the triangles
  let triangles = 0;
  await page.route("**/outputs/surface", async (route) => {
    const glb = await (await fetch(route.request().url().replace(/surface$/, "report"))).json();
    triangles = (glb as { triangles: number }).triangles;
    const header = Buffer.from(JSON.stringify({ triangle_distance: { dtype: "F32", shape: [triangles], data_offsets: [0, 4 * triangles] } }));
    const file = Buffer.alloc(8 + header.length + 4 * triangles);
    file.writeBigUInt64LE(BigInt(header.length));
    header.copy(file, 8);
    for (let t = 0; t < triangles; t++) file.writeFloatLE((0.01 * t) / triangles, 8 + header.length + 4 * t);
    const range = /bytes=(\d+)-(\d+)/.exec(route.request().headers().range ?? "");
    if (!range) return route.continue();
    await route.fulfill({ status: 206, body: file.subarray(Number(range[1]), Number(range[2]) + 1), contentType: "application/octet-stream" });
  });
  await openPage(page, service);
  await chooseExample(page, "Dumbbell");
  await submit(page);
  await showsSurface(page);
  await expect(page.getByRole("radio", { name: "Distance error" })).toBeEnabled();
  const [inSpace, inSquare] = [new Set<string>(), new Set<string>()];
  for (const mode of ["Checkerboard", "UV grid", "Normals", "Area distortion", "Distance error", "Wireframe"]) {
    const drawn = await page.locator(".chart .viewport").getAttribute("data-drawn");
    await page.getByRole("radio", { name: mode }).check({ force: true });
    if (mode !== "Checkerboard") await expect(page.locator(".chart .viewport")).not.toHaveAttribute("data-drawn", drawn!);
    await expect(page.locator(".space canvas")).toHaveAttribute("aria-label", new RegExp(`shown as ${mode.toLowerCase()}`));
    await page.mouse.move(5, 5);
    inSpace.add(await seen(surfacePicture(page)));
    inSquare.add(await seen(chartPicture(page)));
    await accessible(page);
  }
  expect(inSpace.size).toBe(6);
  expect(inSquare.size).toBe(6);
  await page.getByRole("radio", { name: "Distance error" }).check({ force: true });
  await expect(page.locator(".scale li").last()).toHaveText(/%$/);
});

test("what is pointed at in one picture is marked in both", async ({ page, service }) => {
  await openPage(page, service);
  const marks = (view: string) => page.locator(`.${view} .overlay circle`);
  await chartPicture(page).hover({ position: { x: 150, y: 220 } });
  await expect(marks("space")).toHaveCount(2);
  await expect(marks("chart")).toHaveCount(2);
  await expect(page.locator(".probe")).toContainText(/u, v 0\.\d+, 0\.\d+ θ, φ \d+\.\d°, \d+\.\d° x, y, z .* triangle \d/);
  await page.mouse.move(5, 5);
  await expect(marks("space")).toHaveCount(0);
  const box = (await surfacePicture(page).boundingBox())!;
  await surfacePicture(page).hover({ position: { x: box.width / 2, y: box.height / 2 } });
  await expect(marks("chart")).toHaveCount(2);
  // the middle of the ball is seen from where the camera is
  const told = /x, y, z ([^ ]+), ([^ ]+), ([^ ]+)/.exec((await page.locator(".probe").textContent())!)!;
  const [x, y, z] = told.slice(1).map((text) => Number(text.replace("\u2212", "-").replace(/[^\d.-]/g, "")));
  expect(Math.hypot(x, y, z)).toBeCloseTo(1, 1);
  expect(x * Math.sin(0.6) * Math.cos(0.45) + y * Math.sin(0.45) + z * Math.cos(0.6) * Math.cos(0.45)).toBeGreaterThan(0.99);
  // by keys alone
  await page.mouse.move(5, 5);
  await page.getByRole("application", { name: /UV square/ }).focus();
  await page.keyboard.press("ArrowRight");
  await expect(marks("space")).toHaveCount(2);
  const before = await page.locator(".probe").textContent();
  await page.keyboard.press("ArrowDown");
  await expect(page.locator(".probe")).not.toHaveText(before!);
  await expect(page.locator("#announcements")).toContainText("u, v");
});

test("a long job is cancelled, and sent again", async ({ page, service }) => {
  await openPage(page, service);
  await chooseEndlessJob(page);
  const id = await submit(page);
  await reaches(page, "running");
  await accessible(page);
  await page.locator(".job-head").getByRole("button", { name: "Cancel" }).click();
  await reaches(page, "canceled");
  await expect(page.locator(".recent .badge").first()).toHaveText("canceled");
  await accessible(page);
  await page.locator(".job-head").getByRole("button", { name: "Retry" }).click();
  await expect(page).not.toHaveURL(new RegExp(id));
  await expect(page.locator(".job-head .badge")).toHaveText(/queued|running/);
  // from the list this time
  await page.locator(".recent").getByRole("button", { name: /^Cancel/ }).first().click();
  await reaches(page, "canceled");
});

test("a mesh and a network are uploaded, described and wrapped", async ({ page, service }) => {
  await openPage(page, service);
  const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.getByRole("button", { name: "choose a file" }).click()]);
  await chooser.setFiles(join(FIXTURES, "networks/blob.safetensors"));
  await expect(page.locator(".described")).toContainText("a network of");
  await expect(page.locator(".described")).toContainText("48, 48, 48, 1");
  await page.getByLabel("Size").selectOption("100x50");
  await accessible(page);
  await submit(page);
  await showsSurface(page);
  await expect(page.getByRole("heading", { name: "blob" })).toBeVisible();
});

test("what a network's file does not say is said beside it", async ({ page, service }) => {
  await openPage(page, service);
  await page.getByText("What a file does not say").click();
  const options = page.locator("#field-options");
  await options.fill('{"w0": 12, "domain": {"min": [-0.9, -0.9, -0.9], "max": [0.9, 0.9, 0.9]}}');
  await page.locator("#file").setInputFiles(join(FIXTURES, "networks/families/blob_siren.pth"));
  await expect(page.locator(".described")).toContainText("siren");
  await page.getByLabel("Size").selectOption("100x50");
  await expect(page.locator(".cost")).toContainText("4,902 vertices");
  await accessible(page);
  const id = await submit(page);
  await showsSurface(page);
  const asked = (await (await fetch(`${service.api}/v1/jobs/${id}/request`)).json()) as { field: { w0: unknown } };
  expect(asked.field.w0).toBe(12);
  await options.fill("{");
  await expect(page.locator(".cost")).toContainText("not JSON");
});

test("a dropped scene can be edited", async ({ page, service }) => {
  await openPage(page, service);
  const data = await page.evaluateHandle(() => {
    const transfer = new DataTransfer();
    transfer.items.add(new File(['{"sphere": {"radius": 0.5}}'], "egg.json", { type: "application/json" }));
    return transfer;
  });
  await page.locator(".drop").dispatchEvent("drop", { dataTransfer: data });
  await expect(page.locator("#scene")).toHaveValue(/sphere/);
  await page.locator("#scene").fill('{"ellipsoid": {"radii": [0.5, 0.4, 0.6]}}');
  await page.getByLabel("Size").selectOption("100x50");
  await expect(page.locator(".cost")).toContainText("4,902 vertices");
  await submit(page);
  await showsSurface(page);
  await expect(page.getByRole("heading", { name: "egg" })).toBeVisible();
});

test("a curve is shown as its outline", async ({ page, service }) => {
  await openPage(page, service);
  await page.getByLabel("Example").selectOption({ label: "Moon" });
  await submit(page);
  await reaches(page, "succeeded");
  await expect(page.locator(".planar img")).toHaveJSProperty("complete", true);
  expect(await page.locator(".planar img").evaluate((image: HTMLImageElement) => image.naturalWidth)).toBeGreaterThan(0);
  await accessible(page);
});

test("a job is opened by its address, and the list shows its picture", async ({ page, service }) => {
  const body = { field: { scene: { sphere: { radius: 0.6 } } }, shrink: { lattice: { octahedral: { n: 16 } } } };
  const init = { method: "POST", headers: { "content-type": "application/json", prefer: "wait=60" }, body: JSON.stringify(body) };
  const job = (await (await fetch(`${service.api}/v1/jobs`, init)).json()) as { id: string };
  await openPage(page, service, `#/jobs/${job.id}`);
  await showsSurface(page);
  await expect(page.locator(".job-head")).toContainText("octahedral:16");
  // it has no output surface, so there are no distances, and the page says so
  await expect(page.getByRole("radio", { name: "Distance error" })).toBeDisabled();
  await expect(page.locator(".legend")).toContainText("not among this job");
  await page.locator(".recent li.open img").scrollIntoViewIfNeeded();
  await expect.poll(() => page.locator(".recent li.open img").evaluate((image: HTMLImageElement) => image.naturalWidth)).toBeGreaterThan(0);
});

test("older jobs are listed on demand, and a job that was sent from elsewhere is sent again", async ({ page, service }) => {
  const send = async (scene: unknown): Promise<string> => {
    const body = { field: { scene }, labels: { name: "sent from elsewhere" } };
    const init = { method: "POST", headers: { "content-type": "application/json", prefer: "wait=60" }, body: JSON.stringify(body) };
    return ((await (await fetch(`${service.api}/v1/jobs`, init)).json()) as { id: string }).id;
  };
  const ring = await send({ torus: { major: 0.5, minor: 0.2 } });
  for (let k = 0; k < 12; k++) await send({ circle: { radius: 0.5 } });
  await openPage(page, service);
  await expect(page.locator(".recent li")).toHaveCount(12);
  const older = page.locator(`.recent a[href="#/jobs/${ring}"]`);
  await expect(older).toHaveCount(0);
  await page.getByRole("button", { name: "Show more" }).click();
  await expect(older).toHaveCount(1);
  await accessible(page);
  await older.click();
  await reaches(page, "failed");
  await page.getByText("The same job as a program").last().click();
  await expect(page.locator(".job .code-text")).toContainText('"torus"');
  await page.locator(".job-head").getByRole("button", { name: "Retry" }).click();
  await expect(page).not.toHaveURL(new RegExp(ring));
  await reaches(page, "failed");
  await expect(page.locator(".job .problem")).toContainText("genus");
});
