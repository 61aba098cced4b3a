import { execFile } from "node:child_process";
import { copyFileSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { promisify } from "node:util";
import type { Page } from "@playwright/test";
import { chooseExample, expect, openPage, test } from "./fixtures";

const run = promisify(execFile);
const NETWORK = join(import.meta.dirname, "../../../tests/fixtures/networks/blob.safetensors");
const INTERPRETERS = { curl: ["sh", "-c"], Python: ["python3", "-c"] } as const;

/** The program as it is shown, run in an empty folder; gives the first bytes of the file it made. */
async function result(page: Page, language: keyof typeof INTERPRETERS, made: string, needs?: string): Promise<string> {
  await page.locator(".job-form").getByRole("radio", { name: language }).check({ force: true });
  // the panel is written after it has opened, and again after every choice
  const text = page.locator(".job-form .code-text");
  await expect(text).toContainText(language === "curl" ? `-o ${made}` : `open("${made}"`);
  const program = await text.textContent();
  const folder = mkdtempSync(join(tmpdir(), "shrinkd-program-"));
  try {
    if (needs) copyFileSync(needs, join(folder, "blob.safetensors"));
    const [interpreter, flag] = INTERPRETERS[language];
    await run(interpreter, [flag, program!], { cwd: folder });
    return readFileSync(join(folder, made)).subarray(0, 4).toString();
  } finally {
    rmSync(folder, { recursive: true });
  }
}

test("the programs that are shown make the same job", async ({ page, service, context }) => {
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  await openPage(page, service);
  await chooseExample(page, "Ellipsoid");
  await page.locator(".job-form").getByText("The same job as a program").click();
  expect(await result(page, "curl", "ellipsoid.glb")).toBe("glTF");
  expect(await result(page, "Python", "ellipsoid.glb")).toBe("glTF");
  await page.locator(".job-form").getByRole("button", { name: "Copy" }).click();
  await expect(page.locator("#announcements")).toContainText("The Python program was copied");
  expect(await page.evaluate(() => navigator.clipboard.readText())).toContain("import requests");

  await page.locator("#file").setInputFiles(NETWORK);
  await expect(page.locator(".described")).toContainText("a network of");
  expect(await result(page, "curl", "blob.glb", NETWORK)).toBe("glTF");
  expect(await result(page, "Python", "blob.glb", NETWORK)).toBe("glTF");
});
