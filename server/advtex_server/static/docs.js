// The API as /openapi.json describes it, drawn by Swagger UI. A key that is given stays in this page's memory.

window.SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  validatorUrl: null, // it would send the description to another host
  supportedSubmitMethods: ["get", "head", "post", "put", "patch", "delete"],
});
