/** What every test of the page has: a service, and a watch over what a page must never do. */

import { createHash } from "node:crypto";
import { AxeBuilder } from "@axe-core/playwright";
import { expect, test as base, type Locator, type Page } from "@playwright/test";
import { startService, type Service } from "./service";

interface Fixtures {
  /** Statuses of answers that the test provokes; the browser writes each into its console. */
  provoked: number[];
}

export const test = base.extend<Fixtures & { watched: void }, { service: Service }>({
  service: [
    async ({}, use) => {
      const service = await startService();
      await use(service);
      await service.stop();
    },
    { scope: "worker" },
  ],
  provoked: [[], { option: true }],
  watched: [
    async ({ page, provoked }, use) => {
      const wrong: string[] = [];
      const home = new Set<string>();
      page.on("framenavigated", (frame) => home.add(new URL(frame.url() === "about:blank" ? "http://none" : frame.url()).host));
      page.on("pageerror", (error) => wrong.push(`thrown: ${error.message}`));
      page.on("console", (message) => {
        const expected = provoked.some((status) => message.text().includes(`status of ${status}`)) || (provoked.includes(0) && /ERR_|network error/.test(message.text()));
        if (message.type() === "error" && !expected) wrong.push(`console: ${message.text()}`);
      });
      page.on("request", (request) => {
        const url = new URL(request.url());
        if (url.protocol.startsWith("http") && home.size > 1 && !home.has(url.host)) wrong.push(`asked another host: ${request.url()}`);
      });
      await page.addInitScript(() => {
        document.addEventListener("securitypolicyviolation", (event) => console.error(`policy: ${event.violatedDirective} ${event.blockedURI}`));
      });
      await use();
      expect(wrong).toEqual([]);
    },
    { auto: true },
  ],
});
export { expect };

/** Opens the page, and waits until its first picture is drawn. */
export async function openPage(page: Page, service: Service, hash = ""): Promise<void> {
  await page.goto(`${service.address}/${hash}`);
  await expect(page.locator(".space .viewport")).toHaveAttribute("data-drawn", /\d/);
}

/** Chooses an example and a small lattice. */
export async function chooseExample(page: Page, name: string, size = "100x50"): Promise<void> {
  await page.getByLabel("Example").selectOption({ label: name });
  await page.getByLabel("Size").selectOption(size);
}

/** Chooses a job that takes longer than any test: the paper's loop on the finest lattice. */
export async function chooseEndlessJob(page: Page): Promise<void> {
  await chooseExample(page, "Ellipsoid", "other");
  await page.getByRole("spinbutton", { name: "Columns" }).fill("2048");
  await page.getByRole("spinbutton", { name: "Rows" }).fill("1024");
  await page.getByRole("radio", { name: "Paper" }).check();
}

export async function submit(page: Page): Promise<string> {
  const answered = page.waitForResponse((answer) => answer.url().endsWith("/v1/jobs") && answer.request().method() === "POST");
  await page.getByRole("button", { name: "Shrink a sphere onto it" }).click();
  const job = (await (await answered).json()) as { id: string };
  return job.id;
}

/** Waits for the state in the job's head. */
export async function reaches(page: Page, state: string): Promise<void> {
  await expect(page.locator(".job-head .badge")).toHaveText(state, { timeout: 300_000 });
}

/** Waits for the surface that the job made. */
export async function showsSurface(page: Page): Promise<void> {
  await reaches(page, "succeeded");
  await expect(page.locator(".space figcaption")).toHaveText("Surface");
}

export const surfacePicture = (page: Page): Locator => page.locator(".space .picture");
export const chartPicture = (page: Page): Locator => page.locator(".chart .picture");

/** A fingerprint of what is seen. */
export async function seen(picture: Locator): Promise<string> {
  return createHash("sha256").update(await picture.screenshot()).digest("hex");
}

/** Waits until something else is seen than before, and gives its fingerprint. */
export async function changes(picture: Locator, before: string): Promise<string> {
  await expect.poll(() => seen(picture)).not.toBe(before);
  return seen(picture);
}

/** No rule of axe is broken by what is shown now. */
export async function accessible(page: Page): Promise<void> {
  const { violations } = await new AxeBuilder({ page }).analyze();
  expect(violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html.slice(0, 160)).join(" | ")}`)).toEqual([]);
}

/** The page is no wider than the window. */
export async function fits(page: Page): Promise<void> {
  const [width, window] = await page.evaluate(() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]);
  expect(width).toBeLessThanOrEqual(window);
}
