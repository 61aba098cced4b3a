import { accessible, chooseEndlessJob, chooseExample, expect, openPage, reaches, showsSurface, submit, test } from "./fixtures";
import { startService } from "./service";

test.describe("with refusals", () => {
  test.use({ provoked: [422, 404] });

  test("a fault in the scene is shown with its place, as the service says it", async ({ page, service }) => {
    await openPage(page, service);
    await page.getByText("Scene as JSON").first().click();
    await page.locator("#scene").fill('{"sphere": {"radios": 1}}');
    // before it is sent
    await expect(page.locator("#scene-faults")).toContainText("/field/scene/sphere/radios");
    await page.getByRole("button", { name: "Shrink a sphere onto it" }).click();
    const problem = page.locator(".job-form .problem");
    await expect(problem).toContainText("The request is invalid");
    await expect(problem).toContainText("/field/scene/sphere/radios");
    await expect(problem).toContainText('sphere has no member "radios"');
    await expect(problem).toContainText("invalid_request");
    await accessible(page);
    // a pointer leads to its place
    await page.locator("#scene-faults button").first().click();
    const chosen = await page.locator("#scene").evaluate((area: HTMLTextAreaElement) => area.value.slice(area.selectionStart, area.selectionEnd));
    expect(chosen).toContain("radios");
    await page.locator("#scene").fill("{");
    await expect(page.locator(".cost")).toContainText("The scene is not JSON");
  });

  test("a file that is no field is refused in the service's words", async ({ page, service }) => {
    await openPage(page, service);
    await page.locator("#file").setInputFiles({ name: "noise.ply", mimeType: "application/octet-stream", buffer: Buffer.from("no mesh at all") });
    await expect(page.locator(".described .problem")).toContainText(/unrecognized_input|malformed_input/);
    await accessible(page);
    // what was chosen before is not sent in its place
    await expect(page.locator(".cost")).toContainText("The file noise.ply cannot be read as a field");
    await page.getByRole("button", { name: "Shrink a sphere onto it" }).click();
    await expect(page.locator(".job-form > div > .problem")).toContainText("The file noise.ply cannot be read as a field");
    await chooseExample(page, "Ellipsoid");
    await expect(page.locator(".cost")).toContainText("4,902 vertices");
    await expect(page.locator(".job-form > div > .problem")).toHaveCount(0);
  });

  test("a job that is not there is said to be so", async ({ page, service }) => {
    await page.goto(`${service.address}/#/jobs/01a204e3-7cfe-7621-aecf-7e493a0df60a`);
    await expect(page.locator(".job .problem")).toContainText("unknown_job");
    await accessible(page);
  });
});

test("a shape that cannot be wrapped fails with its cause and places, and can be tried again", async ({ page, service }) => {
  await openPage(page, service);
  await page.getByText("Scene as JSON").first().click();
  await page.locator("#scene").fill('{"torus": {"major": 0.5, "minor": 0.2}}');
  await page.getByLabel("Size").selectOption("100x50");
  const id = await submit(page);
  await reaches(page, "failed");
  const problem = page.locator(".job .problem");
  await expect(problem).toContainText("The zero level set has handles");
  await expect(problem).toContainText("genus");
  await expect(problem).toContainText("(0.000, 0.000, 0.000)");
  await accessible(page);
  await page.locator(".job-head").getByRole("button", { name: "Retry" }).click();
  await expect(page).not.toHaveURL(new RegExp(id));
  await reaches(page, "failed");
});

test.describe("with keys", () => {
  test.use({ provoked: [401] });

  test("a service that wants a key is given one, for this tab", async ({ page }) => {
    const guarded = await startService(true);
    try {
      await page.goto(guarded.address);
      const dialog = page.getByRole("dialog", { name: "Key or token" });
      await expect(dialog).toBeVisible();
      await accessible(page);
      await dialog.getByLabel("Key", { exact: true }).fill(guarded.key());
      await dialog.getByRole("button", { name: "Use this key" }).click();
      await expect(dialog).toBeHidden();
      await expect(page.locator(".recent")).toContainText("No jobs yet");
      await chooseExample(page, "Ellipsoid");
      await submit(page);
      await showsSurface(page);
      // pictures and downloads carry the key
      await expect(page.locator(".recent img")).toHaveAttribute("src", /^blob:/);
      const [download] = await Promise.all([page.waitForEvent("download"), page.locator(".outputs").getByRole("link", { name: "report" }).click()]);
      expect(download.suggestedFilename()).toBe("ellipsoid.report.json");
      await page.getByText("The same job as a program").last().click();
      await expect(page.locator(".job .code-text")).toContainText("$SHRINKD_KEY");
    } finally {
      await guarded.stop();
    }
  });
});

test.describe("with a service that is killed", () => {
  test.use({ provoked: [0, 500, 502] });

  test("a stream that was cut goes on where it was, after the service came back", async ({ page }) => {
    const mortal = await startService();
    try {
      await openPage(page, mortal);
      await chooseEndlessJob(page);
      await submit(page);
      await expect(page.locator(".figures dd").first()).not.toHaveText("\u2013");
      const again = page.waitForRequest((request) => request.url().endsWith("/events") && Number(request.headers()["last-event-id"]) > 0);
      await mortal.restart();
      await again;
      // the end comes by the new stream
      await page.locator(".job-head").getByRole("button", { name: "Cancel" }).click();
      await reaches(page, "canceled");
    } finally {
      await mortal.stop();
    }
  });
});
